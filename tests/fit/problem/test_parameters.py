"""Single numbers of any parameters are fitted, the others stay."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj


class Springs(NamedTuple):
    """Parameters that are not a dictionary."""

    m: Any
    walls: dict


springs = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(p.m * v**2) - 0.5 * jnp.sum(p.walls["k"] * q**2))


SPRINGS = Springs(jnp.array([1.0, 2.0]), {"k": jnp.array([3.0, 5.0])})


@pytest.mark.exhaustive
def test_elements_of_any_pytree():
    """One entry of an array is fitted, the others stay; bounds by element; a run with its own parameters."""
    ts = np.linspace(0.0, 4.0, 60)
    heavy = SPRINGS._replace(m=jnp.array([1.5, 2.0]))
    runs = [lj.integrate(springs, jnp.ones(2), jnp.zeros(2), p, ts=ts).q for p in (SPRINGS, heavy)]
    records = [lj.Record(ts, q=runs[0]), lj.Record(ts, q=runs[1], params={"m": heavy.m})]
    guess = SPRINGS._replace(walls={"k": jnp.array([3.0, 4.0])})
    found = lj.fit(springs, records, guess, free="walls.k[1]", bounds={"walls.k[1]": (0.0, None)})
    assert found.names == ("walls.k[1]",)
    np.testing.assert_allclose(found.params.walls["k"], [3.0, 5.0], rtol=1e-8)
    np.testing.assert_array_equal(found.params.m, SPRINGS.m)
