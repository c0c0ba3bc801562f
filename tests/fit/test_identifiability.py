"""What measurements determine, before a fit and after it."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import PENDULUM, TS, noisy, pendulum


@pytest.mark.exhaustive
def test_identifiability_before_and_after(swinging):
    """A swing determines g/l and c/(m l²); what is not determined gets no uncertainty."""
    record = lj.Record(TS, q=noisy(swinging[0]))
    told = lj.identifiability(pendulum, record, PENDULUM)
    assert told.rank == 2 and told.combined()[0] == "g/l"
    assert "g/l" in repr(told)
    with pytest.warns(lj.FitWarning, match="do not determine"):
        found = lj.fit(pendulum, record, PENDULUM)
    assert np.isnan(found.sd).all() and np.isfinite(found.start_sd[0][0])
    assert "not determined" in repr(found)
    np.testing.assert_allclose(found.values[1] / found.values[2], 9.81 / 1.25, rtol=0.01)
    # Twin: with l known, g and c are determined; m and c only as a ratio.
    assert lj.identifiability(pendulum, record, PENDULUM, free=["g", "c"]).rank == 2
    assert lj.identifiability(pendulum, record, PENDULUM, free=["m", "c"]).combined() == ["c/m"]
    # The scale of L is not determined: all but one common factor.
    scaled = lambda t, q, v, p: 0.5 * p["inertia"] * v**2 + p["weight"] * jnp.cos(q)
    rubbed = lj.System(scaled, dissipation=lambda t, q, v, p: 0.5 * p["drag"] * v**2)
    told = lj.identifiability(rubbed, record, {"inertia": 1.0, "weight": 8.0, "drag": 0.1})
    assert "one common factor of all" in repr(told)
    # A parameter that L does not contain.
    more = PENDULUM | {"colour": 3.0}
    assert lj.identifiability(pendulum, record, more, free=["g", "colour"]).unseen() == ["colour"]
