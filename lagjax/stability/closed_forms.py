"""Hard cases with closed forms: wedge, bead on a hoop, long motions, geodesics of a sphere, redundant constraints."""

from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.numerics import Dopri8
from lagjax.report import FULL, MAIN, QUICK
from lagjax.scenes import bead_on_hoop, jacobi_elliptic, sliding_wedge, sphere_geodesic
from lagjax.stability.trial import ACCURATE, DEGRADED, REFUSED, Trial, by_parameter, zeros
from lagjax.system import Holonomic, System


def single(tree):
    """The tree in float32."""
    return jax.tree.map(np.float32, tree)


# The wedge: mass ratio and angle.


def _wedge_motion(q0: PyTree, v0: PyTree, params: PyTree, ts):
    return sliding_wedge.exact_motion(params, q0, v0, ts)


def wedge():
    """The mass ratio over 24 decades, and an incline that is nearly a wall."""
    at, ts = sliding_wedge.PARAMS, np.linspace(0.0, 0.75, 5)
    rows = [(f"m/M = {ratio:.0e}", {"m": ratio, "M": 1.0}) for ratio in (1e-12, 1e-6, 1.0, 1e6, 1e12)]
    rows += [(f"alpha = pi/2 - {left:.0e}", {"alpha": np.pi / 2 - left}) for left in (1e-3, 1e-6)]
    shown = ("m/M = 1e-12", "m/M = 1e+12", "alpha = pi/2 - 1e-06")
    start = (sliding_wedge.Q0, sliding_wedge.V0)
    return [
        Trial(
            "wedge", name, sliding_wedge.system, *start, at | change, ts, _wedge_motion,
            by_parameter(*start, at, "alpha"), tier=MAIN if name in shown else FULL,
        )
        for name, change in rows
    ]  # fmt: skip


# The bead on the hoop: a pendulum, with or without rotation of the hoop.


def _bead_motion(q0: PyTree, v0: PyTree, params: PyTree, ts):
    return bead_on_hoop.exact_motion(params, q0, ts)


def swing(name: str, change, psi, span, points=6, **what):
    """A swing from rest at ψ over `span` periods; absolute tolerances in proportion to angle and rate."""
    params = {"m": 0.5, "a": 0.75, "g": 9.8125} | change
    period = float(bead_on_hoop.exact_period(params, psi))
    tolerance = what.get("tolerance", 1e-10)
    # The tolerance of the velocity is relative to its largest value.
    rate = float(np.max(np.abs(bead_on_hoop.exact_motion(params, psi, np.linspace(0.0, period, 64))[1])))
    options = {"rtol": np.full(2, tolerance), "atol": tolerance * np.array([psi, rate])} | what.pop("options", {})
    ts = np.linspace(0.0, span * period, points)
    along = by_parameter(psi, 0.0, params, "g") if what.pop("derived", True) else None
    return Trial(
        what.pop("family", "bead"), name, bead_on_hoop.system, psi, 0.0, params, ts, _bead_motion, along,
        options=options, periods=span, **what,
    )  # fmt: skip


def bead():
    """From a plain pendulum to a hoop at omega = 1e6, and a hoop within a billionth of the critical speed."""
    critical = float(np.sqrt(9.8125 / 0.75))
    tiers = {0.0: QUICK, 1e6: QUICK}
    rows = [
        swing(f"omega = {omega:g}", {"omega": omega}, 1.0, 3.7, tier=tiers.get(omega, FULL), derived_in=MAIN)
        for omega in (0.0, 1.0, 1e3, 1e6)
    ]
    for psi in (1.0, 2.0**-10):
        for side in (-1e-9, 1e-9):
            name, omega = f"omega = critical (1 {side:+.0e}), psi = {psi:.3g}", critical * (1 + side)
            tier = MAIN if side > 0 else FULL
            rows.append(swing(name, {"omega": omega}, psi, 3.7, tier=tier, derived_in=MAIN))
    return by_both(rows)


def by_both(rows):
    """The rows by the default method, `Nystrom12` for the bead, and by the default method of constrained systems."""
    return [*rows, *(replace(row, method=Dopri8(), tier=FULL) for row in rows)]


def separatrix():
    """Release close to the top, with the angle from the top, which loses no digits, and from the bottom."""
    rows = []
    for distance in (1e-2, 1e-4, 1e-8):
        params = {"m": 0.5, "a": 0.75, "g": -9.8125, "omega": 0.0}
        unit = np.sqrt(9.8125 / 0.75)
        quarter = float(np.log(8 / distance) / unit)
        tolerance = 1e-10
        options = {"rtol": np.full(2, tolerance), "atol": tolerance * distance * np.array([1.0, unit])}
        rows.append(
            Trial(
                "separatrix", f"{distance:.0e} off the top, from there", bead_on_hoop.system, distance, 0.0, params,
                np.linspace(0.0, 1.2 * quarter, 6), _fall, by_parameter(distance, 0.0, params, "g"), options=options,
                tier=MAIN if distance == 1e-8 else FULL,
            )
        )  # fmt: skip
    for distance in (1e-2, 1e-4, 1e-8):
        name = f"{distance:.0e} off the top, from the bottom"
        rows.append(
            swing(
                name, {"omega": 0.0}, np.pi - distance, 0.3, tolerance=1e-12, family="separatrix",
                amplification=1 / distance, expected=ACCURATE if distance > 1e-8 else None,
            )
        )  # fmt: skip
    # On the other side the pendulum comes as close to the top again, and its energy error decides whether it passes
    # over: errors are amplified by the inverse square of the distance. At 1e-6 double precision cannot represent the
    # answer, and nothing in the motion shows this; its energy looks correct.
    distance = 1e-2
    rows.append(
        swing(
            f"{distance:.0e} off the top, to the top and back", {"omega": 0.0}, np.pi - distance, 0.75,
            family="separatrix", amplification=distance**-2, derived=False,
        )
    )  # fmt: skip
    return by_both(rows)


def _fall(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """χ and its rate from rest at χ0 close to the top (where g < 0): tan(χ/2) = tan(χ0/2) / cn(ω0 t)."""
    rate = jnp.sqrt(-params["g"] / params["a"])
    s2, c2 = jnp.sin(0.5 * q0) ** 2, jnp.cos(0.5 * q0) ** 2
    sn, cn, dn = jacobi_elliptic(rate * ts, c2, s2)
    tangent = jnp.tan(0.5 * q0)
    # χ = 2 atan(tangent / cn), continued through the bottom, χ = π, where cn = 0.
    return 2 * jnp.arctan2(tangent, cn), 2 * tangent * rate * sn * dn / (cn**2 + tangent**2)


# Single precision.


def float32():
    """Cases within the reach of single precision, at its limits, and beyond it."""
    at, start = sliding_wedge.PARAMS, (sliding_wedge.Q0, sliding_wedge.V0)
    rows = []
    for ratio in (1e-6, 1e6):
        params = single(at | {"m": ratio, "M": 1.0})
        rows.append(
            Trial(
                "float32", f"wedge, m/M = {ratio:.0e}", sliding_wedge.system, single(start[0]), single(start[1]),
                params, np.linspace(0.0, 0.75, 5), _wedge_motion, tolerance=1e-5,
            )
        )  # fmt: skip
    for periods, expected, tier in ((3.7, ACCURATE, MAIN), (1000.3, None, FULL), (10000.3, None, FULL)):
        row = swing(f"pendulum, {periods:g} periods", {"omega": 0.0}, 1.0, periods, tolerance=1e-5, derived=False)
        rows.append(_in_single(row, expected, tier))
    row = swing("pendulum, tolerance 1e-9", {"omega": 0.0}, 1.0, 3.7, tolerance=1e-9, derived=False)
    return [*rows, _in_single(row, REFUSED, QUICK)]


def _in_single(row, expected, tier):
    return Trial(
        "float32", row.name, row.system, np.float32(row.q0), np.float32(row.v0), single(row.params), row.ts, row.exact,
        tolerance=row.tolerance, options=row.options, periods=row.periods, expected=expected, tier=tier,
    )  # fmt: skip


def pendulum(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ v² + cos q."""
    return 0.5 * v**2 + jnp.cos(q)


rotor = System(pendulum)
UNIT = {"a": 1.0, "g": 1.0, "omega": 0.0}


def _whole_turns(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """Direction and rate near whole turns, after which the pendulum is back at the bottom with the rate v0."""
    period = bead_on_hoop.rotation_period(UNIT, v0**2 - 2.0)
    over = v0 * (ts - jnp.round(ts / period) * period)
    return jnp.stack([jnp.cos(over), jnp.sin(over)]), v0 + 0 * ts


def _direction(trajectory):
    # The relative error of an angle of six million radians would hide a phase error.
    return jnp.stack([jnp.cos(trajectory.q), jnp.sin(trajectory.q)]), trajectory.v


def long():
    """From a hundred to a million periods."""
    omega = {"omega": 0.0}
    rate, per_turn = 100.0, 24
    turn = float(bead_on_hoop.rotation_period(UNIT, rate**2 - 2.0))
    # Steps at equal angles: their errors due to a weak periodic force cancel over a turn.
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(turn / per_turn), "max_steps": None}

    def turns(n: float, **what):
        return Trial(
            "long", f"{n:.0e} turns, {per_turn} fixed steps each", rotor, 0.0, rate, {}, np.array([0.0, n * turn]),
            _whole_turns, method=diffrax.Tsit5(), tolerance=1e-9, options=fixed, observed=_direction, periods=n, **what,
        )  # fmt: skip

    return [
        *by_both(
            [
                swing("1e2 periods", omega, 1.0, 100.3, family="long", tier=MAIN),
                swing("1e3 periods", omega, 1.0, 1000.3, family="long"),
                swing("1e4 periods", omega, 1.0, 10000.3, family="long", derived=False, expected=None),
            ]
        ),
        swing("1e6 periods, as they come", omega, 1.0, 1e6, family="long", derived=False, expected=REFUSED),
        swing(
            "1e6 periods at 1e-4",
            omega,
            1.0,
            1e6 + 0.3,
            family="long",
            derived=False,
            expected=DEGRADED,
            tolerance=1e-4,
            method=diffrax.Tsit5(),
            options={"max_steps": None},
        ),  # fmt: skip
        turns(1e4),
        turns(1e6),
    ]


def angles_lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ R² (ψ̇² + sin²ψ θ̇²)."""
    return 0.5 * params["R"] ** 2 * (v["psi"] ** 2 + (jnp.sin(q["psi"]) * v["theta"]) ** 2)


by_angles = System(angles_lagrangian)


def _circle(q0: PyTree, v0: PyTree, params: PyTree, ts):
    return sphere_geodesic.exact_embedded(q0, v0, ts)


def _circle_from_angles(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """The exact path in space, from angles and their rates."""
    r, rate = jax.jvp(lambda q: sphere_geodesic.cartesian(params, q["psi"], q["theta"]), (q0,), (v0,))
    speed = jnp.sqrt(jnp.sum(rate**2))
    path, direction = sphere_geodesic.exact_embedded(r, rate / speed, speed * ts)
    return path


def _position_in_space(trajectory):
    return sphere_geodesic.cartesian({"R": sphere_geodesic.PARAMS["R"]}, trajectory.q["psi"], trajectory.q["theta"])


def _over_azimuth(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """ψ and ψ' from the great circle cot ψ = A cos θ + B sin θ through the start."""
    q, slope = jnp.cos(q0) / jnp.sin(q0), -v0 / jnp.sin(q0) ** 2
    shifted = q * jnp.cos(ts - ts[0]) + slope * jnp.sin(ts - ts[0])
    rate = slope * jnp.cos(ts - ts[0]) - q * jnp.sin(ts - ts[0])
    return jnp.arctan2(1.0, shifted), -rate / (1 + shifted**2)


def geodesics():
    """Nearly antipodal points and the pole: embedded in space, by arc length in angles, and over the azimuth."""
    params, rows = sphere_geodesic.PARAMS, []
    near = (0.75, 0.25, np.pi - 0.75 + 1e-6, np.pi + 0.25 + 1e-6)
    for name, ends in (("pi - 1e-6 apart", near), ("over the pole", (0.5, 0.0, 0.25, np.pi))):
        q0, v0 = map(np.asarray, sphere_geodesic.start_towards(params, *ends))
        arc = float(sphere_geodesic.distance(params, *ends))
        along = np.zeros(3), np.cross(q0, v0) / params["R"], zeros(params)
        rows.append(
            Trial(
                "geodesic", f"{name}, embedded", sphere_geodesic.embedded, q0, v0, params, np.linspace(0.0, arc, 5),
                _circle, along,
            )
        )  # fmt: skip
    for miss in (0.0, 1e-3, 1e-6):
        q0, v0 = {"psi": 0.5, "theta": 0.0}, {"psi": -0.4, "theta": 0.4 * miss / np.sin(0.5)}
        along = zeros(q0), {"psi": 0.0, "theta": 1.0}, zeros(params)
        name = f"past the pole by {miss:g}, in angles" if miss else "through the pole, in angles"
        rows.append(
            Trial(
                "geodesic", name, by_angles, q0, v0, params, np.linspace(0.0, 2.1, 5), _circle_from_angles,
                None if miss == 0 else along, observed=_position_in_space,
                amplification=1 / miss if miss else 1.0, tier=FULL if miss else MAIN,
            )
        )  # fmt: skip
    circle = sphere_geodesic.great_circle(*near)
    psi, slope = map(float, sphere_geodesic.exact_over_azimuth(circle.A, circle.B, near[1]))
    rows.append(
        Trial(
            "geodesic", "pi - 1e-6 apart, over the azimuth", sphere_geodesic.over_azimuth, psi, slope, params,
            np.linspace(near[1], near[3], 5), _over_azimuth, (0.0, 1.0, zeros(params)),
        )
    )  # fmt: skip
    q0, v0 = {"psi": 0.0, "theta": 0.0}, {"psi": 0.4, "theta": 0.3}
    at = {"system": by_angles, "q0": q0, "v0": v0, "params": params, "ts": np.linspace(0.0, 2.1, 5)}
    return [*rows, Trial("geodesic", "from the pole, in angles", **at, expected=REFUSED)]


def free_fall(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ |ṙ|² - g y."""
    return 0.5 * jnp.sum(v**2) - params["g"] * q[1]


def rod(t, q: PyTree, params: PyTree):
    """|r|² - a²."""
    return q @ q - params["a"] ** 2


def rod_again(t, q: PyTree, params: PyTree):
    """The same rod, expressed by its length."""
    return 3.0 * (jnp.sqrt(q @ q) - params["a"])


def level(t, q: PyTree, params: PyTree):
    """y stays where it is."""
    return q[1]


def lift(t, q: PyTree, params: PyTree):
    """y rises as ½ t²."""
    return q[1] - 0.5 * t**2


twice = System(free_fall, {"rod": Holonomic(rod), "rod_again": Holonomic(rod_again)})
torn = System(free_fall, {"level": Holonomic(level), "lift": Holonomic(lift)})


def _on_the_rod(q0: PyTree, v0: PyTree, params: PyTree, ts):
    psi, rate = bead_on_hoop.exact_motion(params | {"omega": 0.0}, jnp.arctan2(q0[0], -q0[1]), ts)
    a, (cos, sin) = params["a"], (jnp.cos(psi), jnp.sin(psi))
    return a * jnp.stack([sin, -cos], axis=-1), a * jnp.stack([rate * cos, rate * sin], axis=-1)


def redundant():
    """A rod given twice; two rods of different length; and a point that is both held level and lifted."""
    params, ts = {"a": 0.75, "g": 9.8125}, np.linspace(0.0, 3.0, 5)
    q0, v0 = 0.75 * np.array([np.sin(1.0), -np.cos(1.0)]), np.zeros(2)
    along = by_parameter(q0, v0, params, "g")
    origin, other = np.zeros(2), {"a": 1.5, "g": 9.8125}
    return [
        Trial("redundant", "a rod given twice", twice, q0, v0, params, ts, _on_the_rod, along, periods=1.6),
        Trial("contradictory", "a rod of another length", twice, q0, v0, other, ts, expected=REFUSED),
        Trial("contradictory", "held level and lifted", torn, origin, origin, params, ts, expected=REFUSED),
    ]
