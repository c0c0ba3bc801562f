"""What rows of the report are compared with is a motion: it obeys the equations; twin: not with another parameter."""

from functools import partial

import jax
import numpy as np
import pytest
from scipy import integrate

from lagjax.scenes import bead_on_hoop, sliding_wedge, sphere_geodesic
from lagjax.stability.closed_forms import (
    UNIT,
    _bead_motion,
    _circle_from_angles,
    _on_the_rod,
    _wedge_motion,
    _whole_turns,
    by_angles,
    redundant,
    single,
    twice,
)
from lagjax.stability.stiff_and_chaotic import (
    _braking,
    _on_ellipse,
    _spring,
    _whirl,
    amplifying,
    braked,
    kepler,
    whirled,
)
from tests.by_numpy import by_numpy, equations


def defect(system, exact, q0, v0, params, times):
    """The largest error of dq/dt = v and dv/dt = a along `exact(q0, v0, params, ts)`; `ts` begins with the start's."""
    ts, going = np.append(0.0, times), np.append(0.0, np.ones(len(times)))
    moving = lambda q0, v0, params, ts: jax.jvp(lambda ts: exact(q0, v0, params, ts), (ts,), (going,))
    (q, v), rates = by_numpy(moving)(q0, v0, params, ts)
    errors = []
    for i, t in enumerate(times, 1):
        state, found = jax.tree.map(lambda x, i=i: x[i], ((q, v), rates))
        right = state[1], equations(system, t, *state, params).a
        errors += [np.max(np.abs(x - y)) for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(right), strict=True)]
    return max(errors)


BEAD, ROW = {"m": 0.5, "a": 0.75, "g": 9.8125}, redundant()[0]
WEDGE, AT_REST = sliding_wedge.PARAMS | {"M": 1.0}, (sliding_wedge.Q0, sliding_wedge.V0)
# The system, the closed form, the start, parameters, times; the defect that is allowed, and a change that shows.
CASES = {
    **{
        f"ellipse, {x}": (
            kepler, partial(_on_ellipse, x), (None, None), {"k": 1.0}, (1.0, 3.0, 5.0), 1e-8, {"k": 1.01}
        )
        for x in (0.0, 0.5, 0.9)
    },
    **{
        f"wedge, {m}": (
            sliding_wedge.system, _wedge_motion, AT_REST, WEDGE | {"m": m}, (0.1, 0.5), 1e-10,
            {"alpha": WEDGE["alpha"] + 0.01},
        )
        for m in (1e-12, 1.0, 1e6)
    },
    **{
        f"bead, {w}": (
            bead_on_hoop.system, _bead_motion, (1.0, 0.0), BEAD | {"omega": w}, (0.2, 0.6, 1.0), 1e-8, {"a": 0.8}
        )
        for w in (0.0, 2.0)
    },
    "two rods": (twice, _on_the_rod, (ROW.q0, ROW.v0), ROW.params, (0.3, 0.9, 2.0), 1e-8, {"g": 10.0}),
    **{
        f"whirled spring, {k}": (
            whirled, _whirl, (_spring(k, None).q0, _spring(k, None).v0), {"k": k}, (0.1, 0.3, 2.0), 1e-12 * k + 1e-11,
            {"k": 1.1 * k},
        )
        for k in (10.0, 1e4)
    },
    "brake": (braked, _braking, (0.5, 2.0), {"c": 3.0}, (0.1, 0.3, 2.0), 1e-9, {"c": 3.1}),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_is_a_motion(name):
    """Its rates are its velocities, and its accelerations those of the system."""
    system, exact, start, params, times, allowed, change = CASES[name]
    assert defect(system, exact, *start, params, np.array(times)) < allowed
    other = lambda q0, v0, p, ts: exact(q0, v0, params, ts)
    assert defect(system, other, *start, params | change, np.array(times)) > 1e-3


def test_rows_start_on_their_ellipses():
    """The starts of the report are those of the closed form, at the pericentre; each turn ends where it began."""
    for row in amplifying()[:3]:
        assert row.exact is not None
        exact = by_numpy(partial(row.exact, row.q0, row.v0, row.params))
        q, v = exact(row.ts[0])
        np.testing.assert_allclose(q, row.q0, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(v, row.v0, rtol=1e-12, atol=1e-15)
        np.testing.assert_allclose(exact(2 * np.pi)[0], row.q0, atol=1e-9)


def test_the_derivative_along_the_circles():
    """The row's direction is that of the start by the rate ω at ω = 1; twin: with a wrong slope it is not."""
    k, h = 10.0, 1e-5
    row = _spring(k, None, derived=True)
    start = lambda w: np.array([k / (k - w**2), w * k / (k - w**2)])
    assert row.along is not None
    slope = (start(1 + h) - start(1 - h)) / (2 * h)
    np.testing.assert_allclose([row.along[0][0], row.along[1][1]], slope, rtol=1e-8)
    assert abs(row.along[1][1] - start(1.0)[1]) > 0.1


def test_a_tree_in_single_precision():
    """All numbers become float32."""
    found = single({"a": 0.1, "b": np.array([1.0, 2.0])})
    assert found["a"].dtype == found["b"].dtype == np.float32 and found["a"] == np.float32(0.1)


PARAMS = sphere_geodesic.PARAMS


def test_the_circle_from_angles():
    """The path in space begins along the start's velocity, stays on the sphere, and bends as the angles do."""
    q0, v0 = {"psi": 0.7, "theta": 0.2}, {"psi": 0.4, "theta": 0.3}
    a = equations(by_angles, 0.0, q0, v0, PARAMS).a

    def along(t, bend=1.0):
        q = jax.tree.map(lambda q, v, a: q + v * t + 0.5 * bend * a * t**2, q0, v0, a)
        return sphere_geodesic.cartesian(PARAMS, q["psi"], q["theta"])

    path = lambda t: _circle_from_angles(q0, v0, PARAMS, t[None])[0]
    at_start = lambda f: by_numpy(lambda t: (f(t), jax.jacfwd(f)(t), jax.jacfwd(jax.jacfwd(f))(t)))(0.0)
    found = at_start(path)
    for one, other in zip(found, at_start(along)):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(by_numpy(path)(1.3)), PARAMS["R"], rtol=1e-14)
    # Twin: without the accelerations the path bends otherwise.
    assert np.max(np.abs(found[2] - at_start(partial(along, bend=0.0))[2])) > 1e-2


RATE = 3.0
period_of = by_numpy(lambda rate: bead_on_hoop.rotation_period(UNIT, rate**2 - 2.0))


def test_the_period_of_a_turn():
    """The time of a turn is ∮ dq / √(v² - 2 (1 - cos q)); twin: for another rate it is another one."""
    time = integrate.quad(lambda q: (RATE**2 - 2 * (1 - np.cos(q))) ** -0.5, 0.0, 2 * np.pi, epsabs=1e-12)[0]
    np.testing.assert_allclose(period_of(RATE), time, rtol=1e-12)
    assert abs(period_of(3.1) / time - 1) > 1e-2


def test_after_whole_turns():
    """Direction and rate at and near whole turns, where the angle changes at the rate of the start."""
    period = float(period_of(RATE))
    direction, rate = by_numpy(_whole_turns)(0.0, RATE, {}, np.array([0.0, 5 * period, 5 * period + 1e-5]))
    np.testing.assert_allclose(direction[:, :2], [[1.0, 1.0], [0.0, 0.0]], atol=1e-13)
    np.testing.assert_allclose(direction[1, 2], RATE * 1e-5, rtol=1e-8)
    np.testing.assert_array_equal(rate, RATE)
