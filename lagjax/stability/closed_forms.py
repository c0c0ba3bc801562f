"""Wedge and bead on a hoop: mass ratios, angles, speeds, amplitudes and float32, compared with closed forms."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.numerics import Dopri8
from lagjax.report import FULL, MAIN, QUICK
from lagjax.scenes import bead_on_hoop, jacobi_elliptic, sliding_wedge
from lagjax.stability.trial import ACCURATE, REFUSED, Trial, by_parameter


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
