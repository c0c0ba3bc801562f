"""Geodesics of a sphere: nearly antipodal points and the pole, in three coordinate systems."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.report import FULL, MAIN
from lagjax.scenes import sphere_geodesic
from lagjax.stability.trial import REFUSED, Trial, zeros
from lagjax.system import System


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
