"""Mechanisms on constraints from one position to another: a slider-crank and a four-bar linkage against one angle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import lagjax as lj
from lagjax.mechanisms import slider_crank
from lagjax.mechanisms.mechanism import rod_kinetic_energy, squared_distance
from tests.mechanisms import published


def flat(tree):
    """All numbers of a state, in a row."""
    return np.concatenate([np.ravel(x) for x in jax.tree.leaves(tree)])


@pytest.mark.exhaustive
def test_slider_crank():
    """From SciPy's end on the equation of the crank's angle back to the start's 150 rad/s, the end's velocity and the
    multipliers of `integrate`. The motion has one degree of freedom, never stops and so is a minimum: on rows in units
    of constraints (1e-5 of those of the mass) the index must be counted to say so. Twin: from the end a moment later,
    the start is faster."""
    crank, time = slider_crank.MECHANISM, 0.012
    q_b, v_b = (jax.tree.unflatten(jax.tree.structure(crank.q0), list(x))
                for x in published.slider_crank_end(time, crank.params))  # fmt: skip
    found = lj.connect(crank.system, crank.q0, q_b, 0.0, time, crank.params, outputs=9)
    assert found.kind == "minimum" and found.trajectory is not None
    assert np.allclose(flat(found.start_velocity), flat(crank.v0), rtol=0, atol=150 * 1e-10)
    assert np.allclose(flat(found.end_velocity), flat(v_b), rtol=0, atol=150 * 1e-10)
    assert np.allclose(flat(jax.tree.map(lambda x: x[-1], found.q)), flat(q_b), rtol=0, atol=1e-10)
    known = lj.integrate(crank.system, crank.q0, crank.v0, crank.params, ts=found.t, rtol=1e-13)
    assert np.allclose(flat(found.multipliers), flat(known.multipliers), rtol=0, atol=1600 * 1e-10)
    later = published.slider_crank_end(1.01 * time, crank.params)[0]
    other = lj.connect(
        crank.system, crank.q0, jax.tree.unflatten(jax.tree.structure(crank.q0), list(later)), 0.0, time,
        crank.params, outputs=9,
    )  # fmt: skip
    assert other.start_velocity.crank.angle > 151.0


BASE, CRANK, COUPLER, ROCKER = 3.0, 1.0, 2.5, 2.0


def linkage_lagrangian(t, q, v, params):
    """Three uniform rods of mass one per length; b and c are the ends of the coupler."""
    still = jnp.zeros(2)
    kinetic = rod_kinetic_energy(CRANK, still, v["b"]) + rod_kinetic_energy(ROCKER, v["c"], still)
    kinetic = kinetic + rod_kinetic_energy(COUPLER, v["b"], v["c"])
    heights = 0.5 * CRANK * q["b"][1] + 0.5 * COUPLER * (q["b"][1] + q["c"][1]) + 0.5 * ROCKER * q["c"][1]
    return kinetic - params["g"] * heights


linkage = lj.System(
    linkage_lagrangian,
    {
        "crank": lj.Holonomic(lambda t, q, params: q["b"] @ q["b"] - CRANK**2),
        "coupler": lj.Holonomic(lambda t, q, params: squared_distance(q["b"], q["c"]) - COUPLER**2),
        "rocker": lj.Holonomic(lambda t, q, params: squared_distance(q["c"], jnp.array([BASE, 0.0])) - ROCKER**2),
    },
)


def at_angle(angle):
    """(b, c) of the linkage at an angle of its crank, by the cosine rule."""
    b = CRANK * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    to_base = jnp.array([BASE, 0.0]) - b
    d = jnp.sqrt(to_base @ to_base)
    along = (COUPLER**2 - ROCKER**2 + d**2) / (2 * d)
    across = jnp.sqrt(COUPLER**2 - along**2)
    return jnp.concatenate([b, b + (along * to_base + across * jnp.stack([-to_base[1], to_base[0]])) / d])


def lagrangian_of(angle, rate, g):
    """L on the motion at an angle."""
    x, u = jax.jvp(at_angle, (angle,), (rate,))
    q, v = ({"b": y[:2], "c": y[2:]} for y in (x, u))
    return linkage_lagrangian(0.0, q, v, {"g": g})


def start_rate(angles, time, g):
    """dθ/dt at the start, where ½ J θ̇² + V = E takes the time between two angles: ∫ √(J / 2 (E - V)) dθ."""
    potential, whole = (jax.jit(lambda angle, rate=rate: lagrangian_of(angle, rate, g)) for rate in (0.0, 1.0))

    def parts(angle):
        value = -float(potential(angle))
        return 2 * (float(whole(angle)) + value), value

    def duration(energy):
        def slowness(angle):
            inertia, value = parts(angle)
            return np.sqrt(inertia / (2 * (energy - value)))

        return quad(slowness, *angles, epsabs=0, epsrel=1e-13)[0]

    highest = max(parts(angle)[1] for angle in np.linspace(*angles, 200))
    ends = highest + 1.0, highest + 1e4
    energy = float(np.asarray(brentq(lambda energy: duration(energy) - time, *ends, xtol=1e-13, rtol=1e-14)))
    inertia, value = parts(angles[0])
    return np.sqrt(2 * (energy - value) / inertia)


def multipliers_at(angle, rate, g):
    """λ from M a = F + Aᵀ λ, with the acceleration of the one equation of θ."""
    arguments = angle, rate
    inertia = jax.grad(jax.grad(lagrangian_of, 1), 1)(*arguments, g)
    mixed = jax.grad(jax.grad(lagrangian_of, 1), 0)(*arguments, g)
    second = (jax.grad(lagrangian_of, 0)(*arguments, g) - mixed * rate) / inertia
    slope, bend = jax.jacfwd(at_angle)(angle), jax.jacfwd(jax.jacfwd(at_angle))(angle)
    x, a = at_angle(angle), slope * second + bend * rate**2

    def of_vectors(x, u):
        return linkage_lagrangian(0.0, {"b": x[:2], "c": x[2:]}, {"b": u[:2], "c": u[2:]}, {"g": g})

    mass, force = jax.hessian(of_vectors, 1)(x, a), jax.grad(of_vectors)(x, a)
    b, c = x[:2], x[2:]
    zero = jnp.zeros(2)
    rows = jnp.stack([
        jnp.concatenate([2 * b, zero]), jnp.concatenate([2 * (b - c), 2 * (c - b)]),
        jnp.concatenate([zero, 2 * (c - jnp.array([BASE, 0.0]))]),
    ])  # fmt: skip
    found = np.linalg.lstsq(rows.T, mass @ a - force, rcond=None)[0]
    return dict(zip(("crank", "coupler", "rocker"), found))


@pytest.mark.exhaustive
def test_four_bar_linkage():
    """The start velocity is that of the energy whose motion takes the time, by quadrature, and the multipliers are
    those of M a = F + Aᵀ λ, all to 1e-10. Twin: without gravity it is another."""
    angles, time, g = (0.5, 2.3), 0.4, 9.81
    a, b = ({"b": x[:2], "c": x[2:]} for x in map(at_angle, angles))
    found = lj.connect(linkage, a, b, 0.0, time, {"g": g}, outputs=9)
    rate = start_rate(angles, time, g)
    exact = jax.jvp(at_angle, (angles[0],), (rate,))[1]
    assert found.kind == "minimum"
    assert np.max(np.abs(flat(found.start_velocity) - exact)) < 1e-10
    assert np.max(np.abs(flat(jax.tree.map(lambda x: x[-1], found.q)) - at_angle(angles[1]))) < 1e-10
    known = multipliers_at(angles[0], rate, g)
    assert all(abs(found.multipliers[name][0] / known[name] - 1) < 1e-10 for name in known)
    assert np.max(np.abs(jax.jvp(at_angle, (angles[0],), (start_rate(angles, time, 0.0),))[1] - exact)) > 0.1


@pytest.mark.exhaustive
def test_derivatives_on_a_constraint():
    """By a parameter and an end on the constraint, in both modes: those of the angle by SciPy, by differences."""
    rod = lj.System(
        lambda t, q, v, params: 0.5 * v @ v - params["g"] * q[1],
        {"rod": lj.Holonomic(lambda t, q, params: q @ q - 1.0)},
    )

    def start_speed(g, angle):
        end = jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        return lj.connect(rod, jnp.array([1.0, 0.0]), end, 0.0, 0.5, {"g": g}, outputs=2).start_velocity[1]

    def by_angle(g, angle):
        def off(speed):
            options = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-12}
            return solve_ivp(lambda t, y: [y[1], -g * np.cos(y[0])], (0, 0.5), [0.0, speed], **options).y[0, -1] - angle

        return float(np.asarray(brentq(off, 0.0, 10.0, xtol=1e-13)))

    at, step = (3.0, 0.7), 1e-3
    exact = [(by_angle(*(np.array(at) + d)) - by_angle(*(np.array(at) - d))) / (2 * step) for d in step * np.eye(2)]
    for mode in (jax.jacfwd, jax.jacrev):
        assert np.allclose(jax.jit(mode(start_speed, (0, 1)))(*at), exact, rtol=1e-6)
