"""Equilibria and steady motions: against closed forms, on constraints, in programs, and where there are none."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.balance import NO_BALANCE, NOT_FINITE, NOT_LASTING
from lagjax.scenes import bead_on_hoop, cross_rails
from tests.analysis.steady_systems import about_z, conical
from tests.systems import PARAMS, pendulum

BEAD = bead_on_hoop.PARAMS
tilt_of = lambda params: jnp.arccos(params["g"] / (params["a"] * params["omega"] ** 2))


# One system at rest.


@pytest.mark.slow
def test_pendulum():
    """Rest is stable below and unstable above; starts a turn apart are merged; twin: with -g it is the reverse."""
    found = lj.equilibria(pendulum, PARAMS, starts=[0.3, 3.0, -3.0, 2 * np.pi + 0.2])
    assert len(found) == 2 and np.asarray(found.of_start).tolist() == [0, 1, 1, 0]
    np.testing.assert_allclose(found.q, [0.0, np.pi], atol=1e-14)
    assert found.stable.tolist() == [True, False]
    rate = np.sqrt(PARAMS["g"] / PARAMS["l"])
    np.testing.assert_allclose(np.sort(found.eigenvalues[0].imag), [-rate, rate], rtol=1e-12)
    np.testing.assert_allclose(np.sort(found.eigenvalues[1].real), [-rate, rate], rtol=1e-12)
    upward = lj.equilibria(pendulum, PARAMS | {"g": -PARAMS["g"]}, starts=[0.3, 3.0, -3.0, 2 * np.pi + 0.2])
    assert upward.stable.tolist() == [False, True]


@pytest.mark.exhaustive
def test_bead_and_its_derivatives():
    """cos α = g/(a ω²) with first and second derivatives by a, in programs and lanes; twin: the bottom's."""
    at = lambda a: lj.equilibria(bead_on_hoop.system, BEAD | {"a": a}, starts=[1.0]).q[0]
    exact = lambda a: tilt_of(BEAD | {"a": a})
    a = jnp.linspace(0.5, 2.0, 4)
    for order in (lambda f: f, jax.grad, lambda f: jax.jacfwd(jax.grad(f))):
        found = jax.jit(jax.vmap(order(at)))(a)
        np.testing.assert_allclose(found, jax.vmap(order(exact))(a), rtol=1e-12)
    bottom = lambda a: lj.equilibria(bead_on_hoop.system, BEAD | {"a": a}, starts=[0.0]).q[0]
    assert jax.grad(bottom)(0.75) == 0.0 != jax.grad(at)(0.75)


# Steady motions.


@pytest.mark.slow
def test_cross_rails():
    """R = K R0/(K - m ω²) on either side of the critical speeds; a line at ω² = k/m; none at ω² = K/m, in words."""
    params, start = cross_rails.PARAMS, [{"R": 1.0, "r": 0.125}]
    for omega, stable in ((2.5, True), (5.0, False), (8.0, True)):
        found = lj.equilibria(cross_rails.rotating_system, params | {"omega": omega}, starts=start)
        exact = cross_rails.equilibrium_length(params | {"omega": omega})
        np.testing.assert_allclose([found.q["R"][0], found.q["r"][0]], [exact, 0.0], rtol=1e-13, atol=1e-14)
        assert bool(found.stable[0]) is stable
    line = lj.equilibria(cross_rails.rotating_system, params | {"omega": 4.0}, starts=start)
    assert line.zero_modes.tolist() == [1] and float(line.q["r"][0]) == 0.125
    assert "1 zero mode" in repr(line)
    none = lj.equilibria(cross_rails.rotating_system, params | {"omega": np.sqrt(40.0)}, starts=start)
    assert len(none) == 0 and none.status.tolist() == [NO_BALANCE]
    assert "1 start led to none" in repr(none)


@pytest.mark.exhaustive
def test_the_driven_hoop():
    """Its angle turns at the motor's rate ω, given or found from the constraint; twin: at rest it does not last."""
    start = {"psi": 1.0, "theta": 0.0}
    given = lj.equilibria(bead_on_hoop.driven_system, BEAD, starts=[start], velocities={"psi": 0.0, "theta": 6.0})
    free = {"cyclic": "theta", "hold": None, "velocities": {"psi": 0.0, "theta": 5.0}}
    found = lj.equilibria(bead_on_hoop.driven_system, BEAD, starts=[start], **free)
    for steady in (given, found):
        np.testing.assert_allclose(steady.q["psi"], tilt_of(BEAD), rtol=1e-13)
        np.testing.assert_allclose(steady.v["theta"], BEAD["omega"], rtol=1e-13)
        np.testing.assert_allclose(steady.multipliers["motor"], 0.0, atol=1e-13)
        assert steady.stable.tolist() == [True]
    resting = lj.equilibria(bead_on_hoop.driven_system, BEAD, starts=[start])
    assert len(resting) == 0 and resting.status.tolist() == [NOT_LASTING]


@pytest.mark.exhaustive
def test_conical_pendulum():
    """Along a symmetry given as a function: cos θ = g/(Ω² l), λ = -½ Ω²; also with the momentum Ω l² sin²θ held."""
    params, omega = {"g": 9.0, "l": 1.25}, 4.0
    theta = np.arccos(params["g"] / (omega**2 * params["l"]))
    place = lambda angle: {"r": params["l"] * np.array([np.sin(angle), 0.0, -np.cos(angle)])}
    speed = lambda angle, rate: {"r": rate * params["l"] * np.array([0.0, np.sin(angle), 0.0])}
    settings = {"starts": [place(theta + 0.1)], "cyclic": about_z}
    found = lj.equilibria(conical, params, velocities=speed(theta + 0.1, omega), **settings)
    np.testing.assert_allclose(found.q["r"][0, 2], -params["l"] * np.cos(theta), rtol=1e-13)
    np.testing.assert_allclose(found.multipliers["rod"], [-0.5 * omega**2], rtol=1e-13)
    np.testing.assert_allclose(found.rates, [[omega]], rtol=1e-15)
    # Small motions have the squared frequency Ω² (1 + 3 cos²θ).
    fastest = np.nanmax(np.abs(found.eigenvalues))
    np.testing.assert_allclose(fastest, omega * np.sqrt(1 + 3 * np.cos(theta) ** 2), rtol=1e-9)
    held = lj.equilibria(conical, params, velocities=speed(theta + 0.1, omega), hold="momentum", **settings)
    kept = omega * (params["l"] * np.sin(theta + 0.1)) ** 2
    np.testing.assert_allclose(held.momenta, [[kept]], rtol=1e-13)
    height = -held.q["r"][0, 2]
    np.testing.assert_allclose(held.rates[0, 0] ** 2 * height, params["g"], rtol=1e-12)
    assert abs(held.rates[0, 0] - omega) > 0.1


# Searches that find no equilibrium.


@pytest.mark.slow
def test_starts_that_lead_out():
    """A force that fades, and a root of a negative number: neither is taken for an equilibrium."""
    fading = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.exp(-q))
    assert lj.equilibria(fading, starts=[0.0]).status.tolist() == [NO_BALANCE]
    root = lj.System(lambda t, q, v, p: 0.5 * v**2 - jnp.sqrt(q) * (q - 1) ** 2)
    found = lj.equilibria(root, starts=[-1.0, 1.1])
    assert found.status.tolist() == [NOT_FINITE, 0]
    np.testing.assert_allclose(found.q, [1.0], rtol=1e-9)
    assert "1 start led to none: L, a force or a constraint is not finite" in repr(found)


@pytest.mark.parametrize(
    "settings, words",
    [
        ({"starts": []}, "starts must hold a place to start from"),
        ({"starts": [1.0], "velocities": 1.0}, "L depends on 'q', which moves at a constant rate"),
        ({"starts": [1.0], "cyclic": "angle"}, "cyclic names 'angle', which is no coordinate; there is 'q'"),
        ({"starts": [1.0], "hold": "energy"}, "hold must be"),
        ({"starts": [1.0, {"q": 1.0}]}, "differ in structure"),
    ],
)
def test_bad_input(settings, words):
    """Errors name what is wrong before anything is computed."""
    with pytest.raises(ValueError, match=words):
        lj.equilibria(pendulum, PARAMS, **settings)


def test_traced_velocities_need_names():
    """Which coordinates move is not known while the velocities are traced, unless they are named."""
    with pytest.raises(ValueError, match="(?s)tracing the velocities.*cyclic="):
        jax.make_jaxpr(lambda v: lj.equilibria(pendulum, PARAMS, starts=[0.1], velocities=v).q)(1.0)
