"""Critical points of branches, by kind, with their derivatives."""

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.analysis import steady_systems as steady
from tests.analysis.continuation.test_equilibria import check


@pytest.mark.exhaustive
def test_sleeping_top():
    """Two frequencies meet at ω_c = 2 √(M g l I1)/I3, where the sleeping top wakes, along the held spin."""
    start = steady.UPRIGHT | {"spin": 12.0}
    found = lj.continue_equilibria(steady.top, steady.TOP, steady.UPRIGHT, velocity=start, along="v.spin", to=2.0)
    (critical,) = found.critical
    assert critical.kind == "flutter"
    check(critical, steady.slowest_sleeping_spin, steady.TOP, "v.spin")
    # They meet at half of I3 ω / I1.
    I1, I3, _ = steady.TOP.values()
    np.testing.assert_allclose(critical.frequency, I3 * critical.parameter / (2 * I1), rtol=1e-10)
    branch = found[0]
    off = np.abs(branch.parameter - float(critical.parameter)) > 1e-9
    np.testing.assert_array_equal(branch.stable[off], branch.parameter[off] > float(critical.parameter))


@pytest.mark.exhaustive
def test_flutter_of_a_column():
    """Ziegler's: P l/c = 7/2 - √2 without damping, 41/28 + b²/(2 m l² c) with it (Ziegler, Ing.-Arch. 20 (1952) 49)."""
    for system, exact in ((steady.ziegler, steady.flutter_load), (steady.damped_ziegler, steady.damped_flutter_load)):
        found = lj.continue_equilibria(system, steady.ZIEGLER, np.zeros(2), along="P", to=10.0)
        (critical,) = found.critical
        assert critical.kind == "flutter" and critical.frequency > 0
        check(critical, lambda p, exact=exact: exact(p), steady.ZIEGLER, "P")
    assert steady.flutter_load(steady.ZIEGLER) > 1.3 * steady.damped_flutter_load(steady.ZIEGLER)


@pytest.mark.exhaustive
def test_several_zeros_together():
    """A rotating spherical pendulum: at ω² = g/l its stiffness vanishes in all directions, but it stays stable."""
    params = {"omega": 0.2, "g": 4.0}
    found = lj.continue_equilibria(steady.turning_pendulum, params, np.zeros(2), along="omega", to=3.0)
    (critical,) = found.critical
    assert critical.kind == "multiple zero" and found[0].stable.all()
    check(critical, lambda p: jnp.sqrt(p["g"]), params, "omega")


@pytest.mark.exhaustive
def test_rolling_disk():
    """Rolling straight ahead it is stable above √(g/(3 r)): one of many zero roots grows; no branch crosses."""
    velocity = {name: 8.0 * rate for name, rate in steady.straight_on(steady.UPRIGHT_DISK, steady.DISK).items()}
    settings = {"velocity": velocity, "cyclic": steady.straight_on, "along": "v[0]", "to": 0.5}
    (critical,) = lj.continue_equilibria(steady.disk, steady.DISK, steady.UPRIGHT_DISK, **settings).critical
    assert critical.kind == "divergence"
    check(critical, lambda p: steady.slowest_rolling(p), steady.DISK, "v[0]")
