"""Velocity constraints in motion, against closed forms: rolling, skating, cruising, driven in time.

Each closed form obeys lagjax's equations `M a = F + Aᵀ λ`, `A a = gamma`, and would not with one of the usual errors:

    half Chetaev     the force of λ is ½ Aᵀ λ: phi differentiated as if it were linear in v
    no d(phi)/dt     gamma without the explicit time of phi
    no (d phi/dq) v  gamma without the turning of phi's rows
"""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.by_numpy import by_numpy, equations
from tests.tiers import exhaustive_but

LOOSE, TIGHT = 1e-5, 1e-11
# Below this a residual is round-off: coordinates and velocities are of the order of ten.
ROUND_OFF = 1e-12


def gudermannian(s):
    """gd(s): its sine is tanh(s), its cosine sech(s)."""
    return 2 * jnp.arctan(jnp.tanh(s / 2))


def departure(found, expected):
    """The largest difference between two lists of curves."""
    return max(float(np.max(np.abs(np.asarray(a) - np.asarray(b)))) for a, b in zip(found, expected, strict=True))


# A vertical disk on a plane: heading α, rolling angle φ; the plane may be inclined, with gravity g along x.


def disk_lagrangian(t, q, v, params):
    """L = ½ m (ẋ² + ẏ²) + ½ I φ̇² + ½ J α̇² + m g x."""
    m = params["m"]
    sliding = 0.5 * m * (v["x"] ** 2 + v["y"] ** 2) + m * params["g"] * q["x"]
    return sliding + 0.5 * params["I"] * v["angle"] ** 2 + 0.5 * params["J"] * v["heading"] ** 2


def disk_rolls(t, q, v, params):
    """The point of contact is at rest: ẋ = R φ̇ cos α, ẏ = R φ̇ sin α."""
    along = jnp.stack([jnp.cos(q["heading"]), jnp.sin(q["heading"])])
    return jnp.stack([v["x"], v["y"]]) - params["R"] * v["angle"] * along


vertical_disk = lj.System(disk_lagrangian, {"rolling": lj.Nonholonomic(disk_rolls)})
DISK = {"m": 1.5, "R": 0.75, "I": 0.5, "J": 0.25, "g": 0.0}
DISK_START = {"turn": 1.75, "spin": 4.0, "heading": 0.375}


def disk_exact(params, start, t):
    """q, v, λ: α̇ = Ω constant, φ̇ = c + k sin α with k = m g R / ((m R² + I) Ω); circles for g = 0, then a drift."""
    m, radius, turn, first = params["m"], params["R"], start["turn"], start["heading"]
    heading = first + turn * t
    k = m * params["g"] * radius / ((m * radius**2 + params["I"]) * turn)
    c = start["spin"] - k * jnp.sin(first)
    spin, spin_rate = c + k * jnp.sin(heading), k * turn * jnp.cos(heading)
    x_of = lambda a: radius / turn * (c * jnp.sin(a) + 0.5 * k * jnp.sin(a) ** 2)
    y_of = lambda a: radius / turn * (-c * jnp.cos(a) + k * (0.5 * a - 0.25 * jnp.sin(2 * a)))
    q = {
        "angle": c * t - k / turn * (jnp.cos(heading) - jnp.cos(first)),
        "heading": heading,
        "x": x_of(heading) - x_of(first),
        "y": y_of(heading) - y_of(first),
    }
    v = {
        "angle": spin,
        "heading": turn * jnp.ones_like(t),
        "x": radius * jnp.cos(heading) * spin,
        "y": radius * jnp.sin(heading) * spin,
    }
    ax = radius * (jnp.cos(heading) * spin_rate - jnp.sin(heading) * turn * spin)
    ay = radius * (jnp.sin(heading) * spin_rate + jnp.cos(heading) * turn * spin)
    return q, v, m * jnp.stack([ax - params["g"], ay], axis=-1)


# A sledge on one blade: contact point (x, y), heading α, centre of mass at the distance a ahead of the blade; gravity g
# along x. With g = 0 it is Chaplygin's sleigh.


def sledge_lagrangian(t, q, v, params):
    """L = ½ m |ṙ_c|² + ½ I α̇² + m g x_c, r_c = r + a (cos α, sin α)."""
    c, s = jnp.cos(q["heading"]), jnp.sin(q["heading"])
    a, turn = params["a"], v["heading"]
    kinetic = 0.5 * params["m"] * ((v["x"] - a * turn * s) ** 2 + (v["y"] + a * turn * c) ** 2)
    return kinetic + 0.5 * params["I"] * turn**2 + params["m"] * params["g"] * (q["x"] + a * c)


def blade(t, q, v, params):
    """No sideways velocity: -ẋ sin α + ẏ cos α = 0."""
    return -v["x"] * jnp.sin(q["heading"]) + v["y"] * jnp.cos(q["heading"])


sledge = lj.System(sledge_lagrangian, {"blade": lj.Nonholonomic(blade)})
# I = 3 m a² makes the sleigh's positions elementary: its heading is then 2 gd(s).
SLEIGH = {"m": 1.25, "a": 0.5, "I": 3 * 1.25 * 0.5**2, "g": 0.0}
OUTPUTS = 21


def sleigh_exact(params, t, speed=1.5, first=-1.25):
    """(heading, x, y), their rates and λ of Chaplygin's sleigh: u = A tanh s, ω = (A/b) sech s, s = s₀ + a A t / b².

    b² = (I + m a²)/m. u̇ = a ω², ω̇ = -(a/b²) u ω; the blade's force is m (u ω + a ω̇).
    """
    a, b = params["a"], jnp.sqrt(params["I"] / params["m"] + params["a"] ** 2)
    s = first + a * speed * t / b**2
    u, turn = speed * jnp.tanh(s), speed / b / jnp.cosh(s)
    heading = b / a * gudermannian(s)
    # b = 2 a: ẋ = u cos(2 gd s), ẏ = u sin(2 gd s), integrated over s.
    x = b**2 / a * (jnp.tanh(s) ** 2 - jnp.log(jnp.cosh(s)))
    y = b**2 / a * (gudermannian(s) - jnp.tanh(s) / jnp.cosh(s))
    v = jnp.stack([turn, u * jnp.cos(heading), u * jnp.sin(heading)])
    return jnp.stack([heading, x, y]), v, params["m"] * u * turn * (1 - a**2 / b**2)


def named(values):
    """A vector (heading, x, y) by name."""
    return dict(zip(("heading", "x", "y"), values))


# A particle that keeps its speed in a uniform field: a velocity constraint that is not linear in the velocity.


def thrown(t, q, v, params):
    """L = ½ m |v|² - m g y."""
    return params["m"] * (0.5 * jnp.dot(v, v) - params["g"] * q[1])


def speed_kept(t, q, v, params):
    """|v|² = c²."""
    return jnp.dot(v, v) - params["c"] ** 2


cruise = lj.System(thrown, {"cruise": lj.Nonholonomic(speed_kept)})
CRUISE = {"m": 1.5, "g": 9.8125, "c": 4.0, "first": 1.375}


def cruise_exact(params, t):
    """q, v, μ: v = c (sech s, tanh s) with s = s₀ - g t / c, since ċ = 0 leaves ψ̇ = -(g/c) cos ψ; 2 c μ = m g sin ψ."""
    g, c, first = params["g"], params["c"], params["first"]
    s = first - g * t / c
    x = c**2 / g * (gudermannian(first) - gudermannian(s))
    y = c**2 / g * (jnp.log(jnp.cosh(first)) - jnp.log(jnp.cosh(s)))
    v = c * jnp.stack([1 / jnp.cosh(s), jnp.tanh(s)], axis=-1)
    return jnp.stack([x, y], axis=-1), v, params["m"] * g * jnp.tanh(s) / (2 * c)


def cruise_run(params, ts, tol, **options):
    """(q, v, μ) at `ts` from the closed form's start."""
    q0, v0, _ = cruise_exact(params, jnp.zeros(()))
    params = {name: params[name] for name in ("m", "g", "c")}
    traj = lj.integrate(cruise, q0, v0, params, ts=ts, rtol=tol, atol=tol, **options)
    return traj.q, traj.v, traj.multipliers["cruise"]


# A particle driven in time: v_y = x f(t), f = cos(ν t).


def driving(t, q, v, params):
    """v_y - x cos(ν t)."""
    return v[1] - q[0] * jnp.cos(params["nu"] * t)


driven = lj.System(thrown, {"drive": lj.Nonholonomic(driving)})
DRIVEN = {"m": 1.5, "g": 9.8125, "nu": 2.5}


def driven_exact(params, t, x=0.75, speed=1.25):
    """q, v, λ: x runs freely, y = ∫ x cos(ν t) dt, λ = m (ẏ̇ + g) with ÿ = ẋ cos - ν x sin."""
    nu, position = params["nu"], x + speed * t
    c, s = jnp.cos(nu * t), jnp.sin(nu * t)
    y = position * s / nu + speed * (c - 1) / nu**2
    force = params["m"] * (speed * c - nu * position * s + params["g"])
    return jnp.stack([position, y]), jnp.stack([speed * jnp.ones_like(t), position * c]), force


def by_name(exact):
    """The sledge's closed form in its coordinates."""

    def found(params, t):
        q, v, force = exact(params, t)
        return named(q), named(v), force

    return found


ALONG, ACROSS = "half Chetaev", "no (d phi/dq) v"
disk_form = lambda params, t: disk_exact(params, DISK_START, t)
# The system, its velocity constraint and parameters, the closed form, the outputs, the errors that it would show.
CLOSED = {
    "disk": (vertical_disk, disk_rolls, DISK | {"g": 6.25}, disk_form, np.linspace(0.0, 6.0, 25), (ALONG, ACROSS)),
    "sleigh": (sledge, blade, SLEIGH, by_name(sleigh_exact), np.linspace(0.0, 4.0, OUTPUTS), (ALONG, ACROSS)),
    # Half of Chetaev's force does not change the motion of a single constraint but doubles μ.
    "cruise": (cruise, speed_kept, CRUISE, cruise_exact, np.array([0.0, 0.5, 1.0, 2.0]), (ALONG,)),
    "driven": (driven, driving, DRIVEN, driven_exact, np.linspace(0.0, 4.0, 9), (ALONG, ACROSS, "no d(phi)/dt")),
}


@pytest.mark.parametrize("name", CLOSED)
def test_closed_forms_obey_the_equations(name):
    """Along each closed form lagjax's equations give its accelerations and λ; with an error built in they do not."""
    system, phi, params, exact, _, flaws = CLOSED[name]
    moving = by_numpy(lambda t: jax.jvp(lambda t: exact(params, t), (t,), (jnp.ones_like(t),)))
    (q, v, force), (rate, second, _) = moving(0.75)
    assert departure(jax.tree.leaves(rate), jax.tree.leaves(v)) < 1e-13
    right = [*jax.tree.leaves(second), force]
    found = equations(system, 0.75, q, v, params)
    assert departure([*jax.tree.leaves(found.a), *found.multipliers.values()], right) < 1e-11
    _, by_time = by_numpy(lambda t, q, v: jax.jvp(lambda t: phi(t, q, v, params), (t,), (1.0,)))(0.75, q, v)
    flat = np.concatenate([np.ravel(x) for x in right])
    for flaw in flaws:
        acting = 0.5 * found.rows if flaw == ALONG else found.rows
        gamma = {ALONG: found.gamma, ACROSS: -np.atleast_1d(by_time), "no d(phi)/dt": found.gamma + by_time}[flaw]
        matrix = np.block([[found.mass, -acting.T], [found.rows, np.zeros((len(gamma), len(gamma)))]])
        solved = np.linalg.solve(matrix, np.append(found.force, gamma))
        assert np.max(np.abs(solved - flat)) > 0.1, flaw


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(("disk", "driven"), CLOSED))
def test_motions(name):
    """Integrated, each follows its closed form, with λ; and its constraint holds at any tolerance."""
    system, phi, params, exact, ts, _ = CLOSED[name]
    # Leading axes are times.
    in_time = by_numpy(jax.vmap(lambda t: exact(params, t)))
    start = by_numpy(lambda t: exact(params, t))(0.0)

    def run(tol, ts):
        traj = lj.integrate(system, *start[:2], params, ts=ts, rtol=tol, atol=tol)
        off = departure(*map(jax.tree.leaves, ((traj.q, traj.v, traj.multipliers), in_time(ts))))
        residual = by_numpy(jax.vmap(lambda t, q, v: phi(t, q, v, params)))(traj.t, traj.q, traj.v)
        return traj, off, np.max(np.abs(residual))

    traj, off, _ = run(TIGHT, ts)
    assert off < 2e-10
    # The constraint does no work.
    assert name in ("cruise", "driven") or float(traj.drift()) < 1e-10
    # Steps end at outputs: where none are they are long, and have errors.
    _, off, residual = run(LOOSE, np.append(1e-6 * ts[:-1], ts[-1]))
    assert 1e-8 < off < 1e-2 and residual < ROUND_OFF


# A disk that may tilt: heading α, inclination θ of its plane (π/2 upright), rotation ψ about its axis. With
# h = (cos α, sin α, 0) ahead, ℓ across, d = ℓ cos θ + ẑ sin θ from the contact to the centre and n = h × d the axis,
# the angular velocity is ω = θ̇ h + α̇ sin θ d + (ψ̇ + α̇ cos θ) n.


def tilting_lagrangian(t, q, v, params):
    """L = ½ m |ṙ|² + ½ I₁ (θ̇² + α̇² sin²θ) + ½ I₃ (ψ̇ + α̇ cos θ)² - m g z."""
    m, spin = params["m"], v["spin"] + v["heading"] * jnp.cos(q["tilt"])
    across = v["tilt"] ** 2 + (v["heading"] * jnp.sin(q["tilt"])) ** 2
    kinetic = 0.5 * m * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2)
    return kinetic + 0.5 * params["I1"] * across + 0.5 * params["I3"] * spin**2 - m * params["g"] * q["z"]


def touches(t, q, params):
    """The lowest point of the rim is on the plane: z = R sin θ."""
    return q["z"] - params["R"] * jnp.sin(q["tilt"])


def contact_at_rest(t, q, v, params):
    """The horizontal part of ṙ = R ω × d = R (θ̇ n - ω₃ h)."""
    c, s = jnp.cos(q["heading"]), jnp.sin(q["heading"])
    spin = v["spin"] + v["heading"] * jnp.cos(q["tilt"])
    sideways = -v["tilt"] * jnp.sin(q["tilt"])
    return jnp.stack(
        [v["x"] - params["R"] * (-sideways * s - spin * c), v["y"] - params["R"] * (sideways * c - spin * s)]
    )


tilting_disk = lj.System(
    tilting_lagrangian, {"contact": lj.Holonomic(touches), "rolling": lj.Nonholonomic(contact_at_rest)}
)
COIN = {"m": 1.25, "R": 0.5, "I1": 1.25 * 0.5**2 / 4, "I3": 1.25 * 0.5**2 / 2, "g": 9.8125}


def coin_state(params, heading, tilt, u, p, w, x=0.0, y=0.0):
    """(q, v) of the rolling disk with angular velocity u h + p d + w n."""
    radius, turn, sideways = params["R"], p / np.sin(tilt), -u * np.sin(tilt)
    c, s = np.cos(heading), np.sin(heading)
    q = {"heading": heading, "spin": 0.0, "tilt": tilt, "x": x, "y": y, "z": radius * np.sin(tilt)}
    v = {
        "heading": turn,
        "spin": w - turn * np.cos(tilt),
        "tilt": u,
        "x": radius * (-sideways * s - w * c),
        "y": radius * (sideways * c - w * s),
        "z": radius * np.cos(tilt) * u,
    }
    return q, v


@pytest.mark.exhaustive
@pytest.mark.parametrize("mode, options", [(jax.jacrev, {}), (jax.jacfwd, {"adjoint": diffrax.ForwardMode()})])
def test_gradients_of_cruising(mode, options):
    """Through a nonlinear velocity constraint, the closed form's derivatives of place, velocity and μ."""
    ts = np.array([0.0, 1.25])
    final = lambda params: jnp.concatenate([jnp.ravel(part[-1]) for part in cruise_run(params, ts, TIGHT, **options)])
    exact = lambda params: jnp.concatenate([jnp.ravel(part) for part in cruise_exact(params, jnp.asarray(1.25))])
    found, expected = jax.jit(mode(final))(CRUISE), jax.jacfwd(exact)(CRUISE)
    for name in CRUISE:
        np.testing.assert_allclose(found[name], expected[name], atol=2e-10)
