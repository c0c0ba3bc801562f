"""Routh's function: what is left moves as in the whole."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.formulations import Routhian


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
