"""Hamilton's function and equations against closed forms and Lagrange's equations.

Routh's function: what is left moves as in the whole.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.formulations import Routhian

Q = np.array([0.25, 0.5, -0.125])


P = np.array([3.0, 1.0, -2.0])


def relativistic(t, q, v, params):
    """A relativistic particle on a spring whose stiffness grows with time."""
    m, c = params["m"], params["c"]
    return -m * c**2 * jnp.sqrt(1 - v @ v / c**2) - 0.5 * params["k"] * (1 + t) * q @ q


def magnetic(t, q, v, params):
    """A charge in a uniform magnetic field along z and an oscillating electric field along x."""
    B, m = params["B"], params["m"]
    return 0.5 * m * v @ v + 0.5 * B * (q[0] * v[1] - q[1] * v[0]) + jnp.cos(t) * q[0]


FAST, CHARGE = lj.System(relativistic), lj.System(magnetic)
OF_FAST, OF_CHARGE = {"m": 1.25, "c": 2.0, "k": 0.75}, {"m": 1.5, "B": 2.5}


def exact_fast(q, p, t, params):
    """√(p²c² + m²c⁴) + V."""
    m, c = params["m"], params["c"]
    return jnp.sqrt(p @ p * c**2 + m**2 * c**4) + 0.5 * params["k"] * (1 + t) * q @ q


def exact_charge(q, p, t, params):
    """(p - A)²/2m + V, with A = B/2 (-y, x, 0)."""
    A = 0.5 * params["B"] * jnp.stack([-q[1], q[0], 0.0 * q[2]])
    return (p - A) @ (p - A) / (2 * params["m"]) - jnp.cos(t) * q[0]


@pytest.mark.parametrize(
    "system, exact, params, order",
    [(CHARGE, exact_charge, OF_CHARGE, 1),
     *(pytest.param(*x, 2, marks=pytest.mark.exhaustive)
       for x in ((FAST, exact_fast, OF_FAST), (CHARGE, exact_charge, OF_CHARGE)))],
    ids=["charge", "fast", "more of the charge"],
)  # fmt: skip
def test_hamiltonians_in_closed_form(system, exact, params, order):
    """H and its first and second derivatives; Hamilton's equations agree with Lagrange's. Twin: a wrong sign."""
    H, t = lj.hamiltonian(system), 0.5

    @jax.jit
    def both(q, p):
        first = lambda f: jax.value_and_grad(f, argnums=(0, 1))(q, p)
        second = lambda f: jax.jacfwd(jax.grad(f, argnums=1), argnums=(0, 1))(q, p)
        at = lambda f: (*first(f), second(f) if order > 1 else None)
        mass = lambda f: jax.grad(lambda m: f(params | {"m": m}))(params["m"]) if order > 1 else None
        found = at(lambda q, p: H(t, q, p, params)), mass(lambda params: H(t, q, p, params))
        known = at(lambda q, p: exact(q, p, t, params)), mass(lambda params: exact(q, p, t, params))
        v = H.velocity(t, q, p, params)
        a = lj.accelerations(system, t, q, v, params)[0]
        momentum = lambda t, q, v: lj.momentum(system, t, q, v, params)
        p_again, p_rate = jax.jvp(momentum, (jnp.asarray(t), q, v), (jnp.ones(()), v, a))
        return found, known, (p_again, (v, p_rate), H.rates(t, q, p, params), found[0][1])

    found, known, (p_again, lagrange, hamilton, slopes) = both(Q, P)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(known)):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(p_again, P, rtol=1e-13)
    for one, other, slope in zip(lagrange, hamilton, (slopes[1], -slopes[0])):
        np.testing.assert_allclose(one, other, atol=1e-12)
        np.testing.assert_allclose(one, slope, atol=1e-12)
    assert np.max(np.abs(lagrange[1] - slopes[0])) > 0.1


@pytest.mark.slow
def test_forces_and_batches():
    """In a dict with friction ṗ is Lagrange's, lane by lane in a batch; NaN if no velocity has the momentum."""
    friction = lambda t, q, v, params: 0.25 * (v["x"] ** 2 + v["y"] ** 2)
    cosh = lambda t, q, v, params: jnp.log(jnp.cosh(v["x"])) + 0.5 * v["y"] ** 2 - q["x"] * q["y"]
    H = lj.hamiltonian(lj.System(cosh, dissipation=friction))
    q = {"x": 0.5, "y": 0.25}
    rates = jax.jit(jax.vmap(lambda x: H.rates(0.0, q, {"x": x, "y": 1.0}, None)))(np.array([0.5, -0.9, 1.5]))
    exact = np.arctanh([0.5, -0.9])
    np.testing.assert_allclose(rates[0]["x"][:2], exact, rtol=1e-12)
    np.testing.assert_allclose(rates[1]["x"][:2], -0.25 - 0.5 * exact, rtol=1e-12)
    assert np.isnan(rates[0]["x"][2])
    with pytest.raises(ValueError, match="no velocity was found that has this momentum"):
        H(0.0, q, {"x": 1.5, "y": 1.0}, None)


def test_a_degenerate_lagrangian_is_named():
    """The error names the coordinate whose velocity is undetermined; systems with constraints are refused."""
    linear = lj.System(lambda t, q, v, params: 0.5 * v["x"] ** 2 + q["x"] * v["y"])
    state = 0.0, {"x": 1.0, "y": 1.0}, {"x": 1.0, "y": 1.0}, None
    with pytest.raises(ValueError, match="L is degenerate in 'y'"):
        lj.hamiltonian(linear)(*state)
    assert np.isnan(jax.jit(lambda x: lj.hamiltonian(linear)(0.0, {"x": x, "y": 1.0}, *state[2:]))(1.0))
    free = lambda t, q, v, params: 0.5 * (v["x"] ** 2 + v["y"] ** 2)
    held = lj.System(free, {"line": lj.Holonomic(lambda t, q, params: q["x"] - q["y"])})
    with pytest.raises(ValueError, match="Hamilton's equations need free coordinates"):
        lj.hamiltonian(held).rates(*state)
    with pytest.raises(TypeError, match="first argument must be a lj.System"):
        lj.hamiltonian(free)


def top(t, q, v, params):
    """A heavy symmetric top: two of its angles are cyclic."""
    spin = v["psi"] + v["phi"] * jnp.cos(q["theta"])
    tilting = v["theta"] ** 2 + (v["phi"] * jnp.sin(q["theta"])) ** 2
    return 0.5 * params["I1"] * tilting + 0.5 * params["I3"] * spin**2 - params["mgl"] * jnp.cos(q["theta"])


TOP = lj.System(top)


OF_TOP = {"I1": 1.0, "I3": 0.5, "mgl": 2.0}


SPINNING = {"phi": 0.1, "psi": 0.2, "theta": 0.5}, {"phi": 1.0, "psi": 20.0, "theta": 0.125}


def reduced_top():
    """The top without its cyclic angles, at the state above."""
    momenta = lj.momentum(TOP, 0.0, *SPINNING, OF_TOP)
    params = {"params": OF_TOP, "momenta": {name: momenta[name] for name in ("phi", "psi")}}
    return lj.routhian(TOP, ["phi", "psi"]), [{"theta": x["theta"]} for x in SPINNING], params


@pytest.mark.slow
def test_the_top_without_its_cyclic_angles():
    """The nutation is Lagrange's and the cyclic velocities are recovered; twin: with other momenta it is not."""
    reduced, state, params = reduced_top()
    full = lj.accelerations(TOP, 0.0, *SPINNING, OF_TOP)[0]["theta"]
    found = lj.accelerations(reduced, 0.0, *state, params)[0]["theta"]
    np.testing.assert_allclose(found, full, rtol=1e-13)
    wrong = params | {"momenta": {name: 1.01 * p for name, p in params["momenta"].items()}}
    assert abs(lj.accelerations(reduced, 0.0, *state, wrong)[0]["theta"] - full) > 1e-2
    assert isinstance(reduced.lagrangian, Routhian)
    back = reduced.lagrangian.velocities(0.0, *state, params)
    np.testing.assert_allclose([back[name] for name in ("phi", "psi")], [1.0, 20.0], rtol=1e-13)
    # The effective potential of Goldstein, Eq. (5.60), for the rest of the motion.
    a, b = params["momenta"]["psi"] / OF_TOP["I1"], params["momenta"]["phi"] / OF_TOP["I1"]
    potential = lambda x: 0.5 * OF_TOP["I1"] * ((b - a * jnp.cos(x)) / jnp.sin(x)) ** 2 + OF_TOP["mgl"] * jnp.cos(x)
    np.testing.assert_allclose(found, -jax.grad(potential)(0.5) / OF_TOP["I1"], rtol=1e-12)


@pytest.mark.exhaustive
def test_a_routhian_moves_as_the_whole():
    """In an array with one entry less and a non-quadratic L, a relativistic central motion."""
    ts = np.linspace(0.0, 2.0, 9)
    polar = lambda t, q, v, p: -jnp.sqrt(1 - v[1] ** 2 - (q[1] * v[0]) ** 2) + p["k"] / q[1]
    system, start, p = lj.System(polar), (np.array([0.25, 1.0]), np.array([0.5, 0.125])), {"k": 0.25}
    params = {"params": p, "momenta": {"q[0]": lj.momentum(system, 0.0, *start, p)[0]}}
    whole = lj.integrate(system, *start, p, ts=ts, rtol=1e-11, atol=1e-11)
    alone = lj.integrate(lj.routhian(system, "q[0]"), start[0][1:], start[1][1:], params, ts=ts, rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(alone.q[:, 0], whole.q[:, 1], atol=1e-9)


@pytest.mark.exhaustive
def test_a_routhian_with_forces_on_what_is_left():
    """A top with a force on its tilt that contains a cyclic velocity, and friction; twins: without either."""
    push = lambda t, q, v, p: {"phi": 0.0 * t, "psi": 0.0 * t, "theta": p["f"] * jnp.cos(t) * v["phi"]}
    forced = lj.System(top, force=push, dissipation=lambda t, q, v, p: 0.5 * p["c"] * v["theta"] ** 2)
    params, (_, state, reduced) = OF_TOP | {"f": 0.5, "c": 0.25}, reduced_top()
    of = lambda system, params: lj.accelerations(system, 0.25, *state, reduced | {"params": params})[0]["theta"]
    whole = lj.accelerations(forced, 0.25, *SPINNING, params)[0]["theta"]
    left = lj.routhian(forced, ["phi", "psi"])
    np.testing.assert_allclose(of(left, params), whole, rtol=1e-12)
    assert abs(of(left, params | {"f": 0.0}) - whole) > 0.1 and abs(of(left, params | {"c": 0.0}) - whole) > 0.01


def test_what_is_not_cyclic_is_named():
    """Errors for a coordinate in L, a force, a constraint; missing momenta; an eliminated coordinate in q."""
    of_theta = {"phi": 0.1, "psi": 0.2}, {"phi": 0.1, "psi": 0.2}
    of_phi = {"theta": 0.5, "psi": 0.2}, {"theta": 0.1, "psi": 0.2}
    momenta = {"params": OF_TOP, "momenta": {"theta": 1.0, "phi": 1.0, "x": 1.0}}
    rubbed = lj.System(top, dissipation=lambda t, q, v, params: 0.5 * v["phi"] ** 2)
    pushed = lj.System(top, force=lambda t, q, v, p: {"phi": jnp.cos(t), "psi": 0.0, "theta": 0.0})
    steered = lj.System(top, force=lambda t, q, v, p: {"phi": 0.0, "psi": 0.0, "theta": jnp.sin(q["phi"])})
    held = lj.System(top, {"held": lj.Holonomic(lambda t, q, params: q["phi"] - q["psi"])})
    cases = [
        (TOP, "theta", of_theta, momenta, "'theta' is not cyclic: L contains it"),
        (TOP, "x", of_phi, momenta, "'x' is not cyclic: L does not contain its velocity"),
        (rubbed, "phi", of_phi, momenta, "'phi' is not cyclic: dissipation acts on it"),
        (pushed, "phi", of_phi, momenta, "'phi' is not cyclic: a force acts on it"),
        (steered, "phi", of_phi, momenta, "'phi' cannot be eliminated: the force contains it"),
        (held, "phi", of_phi, momenta, "'phi' is not cyclic: constraint 'held' contains it"),
        (TOP, "phi", of_phi, OF_TOP, "the parameters of a Routhian are those of the system and the momenta"),
        (TOP, "phi", of_phi, {"params": OF_TOP, "momenta": {}}, "the momentum of 'phi' is missing"),
        (TOP, "phi", SPINNING, momenta, "'phi' is eliminated, but still among the coordinates"),
    ]
    for system, name, state, params, words in cases:
        reduced = lj.routhian(system, name)
        if words.startswith("'x'"):
            state = ({**state[0], "phi": 0.1}, {**state[1], "phi": 0.1})
        with pytest.raises(ValueError, match=words):
            reduced.lagrangian(0.0, *[{k: jnp.asarray(x) for k, x in y.items()} for y in state], params)


def swinging(t, q, v, params):
    """A harmonic oscillator."""
    return 0.5 * v**2 - 0.5 * params["k"] * q**2


@pytest.mark.slow
def test_the_action_is_stationary_on_motions():
    """S of an oscillator in closed form; δS = 0 and δ²S as known; ∂S/∂q₁ is p. Twin: a straight path."""
    system, params, end = lj.System(swinging), {"k": 4.0}, 0.5
    w = 2.0

    def off(size, q1=1.0, straight=0.0):
        motion = lambda t: q1 * jnp.sin(w * t) / jnp.sin(w * end)
        path = lambda t: (1 - straight) * motion(t) + straight * q1 * t / end + size * jnp.sin(jnp.pi * t / end)
        return lj.action(system, path, params, 0.0, end)

    np.testing.assert_allclose(off(0.0), w / (2 * np.tan(w * end)), rtol=1e-13)
    first, second = jax.grad(off)(0.0), jax.grad(jax.grad(off))(0.0)
    assert abs(first) < 1e-13 and abs(jax.grad(lambda size: off(size, straight=1.0))(0.0)) > 0.1
    np.testing.assert_allclose(second, ((np.pi / end) ** 2 - params["k"]) * end / 2, rtol=1e-12)
    np.testing.assert_allclose(jax.grad(lambda q1: off(0.0, q1))(1.0), w / np.tan(w * end), rtol=1e-12)


@pytest.mark.exhaustive
def test_the_action_of_a_trajectory():
    """The action from outputs, with ends between them and backward; twin: the part differs from the whole."""
    system, params, w = lj.System(swinging), {"k": 4.0}, 2.0
    motion = lj.integrate(system, 0.0, w, params, ts=np.linspace(0.0, 1.0, 41), rtol=1e-12, atol=1e-12)
    exact = lambda a, b: 0.25 * w * (np.sin(2 * w * b) - np.sin(2 * w * a))
    whole, error = lj.action(system, motion, error=True)
    np.testing.assert_allclose(whole, exact(0.0, 1.0), rtol=1e-10)
    far = lj.integrate(system, 0.0, w, params, ts=np.array([0.0, 10.0]))
    few, off = jax.jit(lambda far: lj.action(system, far, error=True, pieces=1))(far)
    assert float(error) < 1e-9 and 1e-6 < abs(float(few) - exact(0.0, 10.0)) < 2 * float(off)
    part = lj.action(system, motion, t0=0.11, t1=0.87)
    np.testing.assert_allclose(part, exact(0.11, 0.87), rtol=1e-10)
    np.testing.assert_allclose(lj.action(system, motion, t0=0.87, t1=0.11), -np.asarray(part), rtol=1e-12)
    assert abs(np.asarray(part) - exact(0.0, 1.0)) > 1e-4
    with pytest.raises(ValueError, match="the action is asked from 0 to 2"):
        lj.action(system, motion, t0=0.0, t1=2.0)
    with pytest.raises(ValueError, match="a path that is a function needs its ends"):
        lj.action(system, lambda t: t, params)
    with pytest.raises(TypeError, match="a path must be a function of t, or a Trajectory"):
        lj.action(system, 1.0, params, 0.0, 1.0)


@pytest.mark.exhaustive
def test_the_action_in_a_program():
    """The action of a motion with two outputs and its derivative, in lanes; twin: the chord between them is far off."""
    system, ts = lj.System(swinging), np.array([0.0, 10.0])

    def found(k):
        motion = lj.integrate(system, 1.0, 0.5, {"k": k}, ts=ts)
        return lj.action(system, motion)

    def exact(k):
        w = jnp.sqrt(k)
        q = jnp.cos(w * ts) + 0.5 / w * jnp.sin(w * ts)
        v = 0.5 * jnp.cos(w * ts) - w * jnp.sin(w * ts)
        # Homogeneous of degree two: L = d(qv/2)/dt on motions.
        return 0.5 * (q[1] * v[1] - q[0] * v[0]), 0.5 * (q[1] - q[0]) ** 2 / 10.0 - k * jnp.sum(q**2) / 6 * 10.0

    stiffness = jnp.array([2.0, 3.0])
    values, slopes = jax.jit(jax.vmap(jax.value_and_grad(found)))(stiffness)
    right, by_chord = jax.vmap(exact)(stiffness)
    np.testing.assert_allclose(values, right, rtol=1e-8)
    np.testing.assert_allclose(slopes, jax.vmap(jax.grad(lambda k: exact(k)[0]))(stiffness), rtol=1e-7)
    assert np.all(np.abs(by_chord - right) > 0.1)
