"""Whipple's bicycle, a system of rolling wheels: its modes at each speed against the published table.

Source: Meijaard, Papadopoulos, Ruina & Schwab, *Proc. R. Soc. A* 463 (2007) 1955, Table 2 (eigenvalues from v = 0 to
10 m/s, 14 digits; those of half of the speeds), and §5: the weave speed 4.29238253634111 m/s and the capsize speed
6.02426201538837 m/s.
"""

import numpy as np
import pytest

import lagjax as lj
from benchmarks.speed import bicycle

WEAVE = {
    2: 2.68234517512745 + 1.68066296590675j,
    4: 0.41325331521125 + 3.07910818603206j,
    5: -0.77534188219585 + 4.46486771378823j,
    7: -2.13875644258362 + 7.19525913329805j,
    10: -3.72016840437287 + 10.90681139476287j,
}
CAPSIZE_AND_CASTER = {
    2: (-3.07158645641514, -8.67387984831735),
    4: (-1.42944427361326, -12.15861426576447),
    5: (-0.32286642900409, -14.07838969279822),
    7: (0.10268170574766, -18.15788466125262),
    10: (0.16105338653172, -24.62459635017404),
}
AT_REST = (5.53094371765393, 3.13164324790656, -3.13164324790656, -5.53094371765393)


def published(speed):
    """The four roots in the table, from its frequencies and growth rates."""
    return np.array(AT_REST if speed == 0 else [*CAPSIZE_AND_CASTER[speed], WEAVE[speed]], complex)


def in_order(roots):
    """Sort roots: real ones first, then by falling growth."""
    return np.array(sorted(roots, key=lambda x: (x.imag > 1e-9, -x.real)))


def modes_at(speed, params=bicycle.PARAMS):
    """Upright, straight ahead."""
    return lj.normal_modes(bicycle.system, 0.0, *bicycle.straight(speed), params)


@pytest.mark.slow
def test_the_published_table():
    """Roots of Table 2 from the nonlinear equations, to 14 decimals; twin: another trail gives other roots."""
    for speed in (0, *WEAVE):
        modes = modes_at(float(speed))
        got = in_order(modes.roots[~modes.zero])
        np.testing.assert_allclose(got, in_order(published(speed)), rtol=0, atol=1e-13 * max(1, speed) * 10)
        assert np.sum(modes.zero) == 2
    other = modes_at(5.0, bicycle.PARAMS | {"trail": 0.1})
    assert np.max(np.abs(in_order(other.roots[~other.zero]) - in_order(published(5)))) > 0.1


@pytest.mark.slow
def test_verdicts_and_names():
    """It weaves below 4.29 m/s, falls over slowly above 6.02, and is stable between; zero modes are named."""
    verdicts = {speed: modes_at(speed).verdict for speed in (0.0, 4.29238, 4.29239, 6.02426, 6.02427, 10.0)}
    assert list(verdicts.values()) == [
        "divergence", "flutter", "asymptotically stable", "asymptotically stable", "divergence", "divergence"
    ]  # fmt: skip
    words = repr(modes_at(5.0))
    assert "other speeds in" in words and "shift of yaw" in words
    assert modes_at(5.0).linearisation.shifts == ("front", "rear", "x", "y")
