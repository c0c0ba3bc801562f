"""The pictures of the gallery: every scene and mechanism, with a closed form that it obeys.

    python docs/gallery.py [NAME ...]

writes `docs/gallery/NAME.png`, or all pictures if no name is given. Scenes draw themselves (`SCENE.picture`). The
picture of a mechanism shows its motion on the left, as stills from light to dark, and a closed form of it on the right
(dots: computed).
"""

import io
import sys
from pathlib import Path

import jax
import numpy as np
from PIL import Image

import lagjax as lj
from lagjax.display import plots
from lagjax.mechanisms import MECHANISMS, andrews, bricard, car_axis, driven_crank, n_four_bar, slider_crank
from lagjax.mechanisms.planar import driven_crank_exact, road
from lagjax.mechanisms.spatial import closed, closure
from lagjax.scenes import SCENES, woodpecker

jax.config.update("jax_enable_x64", True)
FOLDER = Path(__file__).parent / "gallery"
STILLS, COLOURS = 9, 128
# Of the axis of the spinning top at its start.
TILT = np.pi / 3


def moved(mechanism, end=None, count=121):
    """The times, and q, v and multipliers of the motion as NumPy arrays."""
    ts = np.linspace(0.0, mechanism.end if end is None else end, count)
    traj = lj.integrate(mechanism.system, mechanism.q0, mechanism.v0, mechanism.params, ts=ts, rtol=1e-8)
    return ts, *jax.tree.map(np.asarray, (traj.q, traj.v, traj.multipliers))


def stills(axis, lines, count):
    """Draw polylines (each (T, points, 2)) at some of the times, later ones darker."""
    for i in np.linspace(0, count - 1, STILLS).astype(int):
        for k, line in enumerate(lines):
            shade = 0.15 + 0.85 * i / (count - 1)
            axis.plot(*line[i].T, "o-", color=plots.COLOURS[k % 5], alpha=shade, markersize=3, linewidth=1.2)
    axis.set(aspect="equal")


def compared(axis, x, known, found, formula, **labels):
    """A closed form as a curve, and the computed values as dots on it."""
    axis.plot(x, known, label=formula, **plots.style(1))
    axis.plot(x[::6], found[::6], "o", color=plots.COLOURS[0], markersize=3, label="computed")
    axis.set(**labels)
    axis.legend(fontsize=8, frameon=False)


def path(*points):
    """Points, each (T, 2) or (2,) if it is fixed, as a polyline (T, points, 2)."""
    length = max(np.ndim(p) > 1 and len(p) or 1 for p in points)
    return np.stack([np.broadcast_to(np.asarray(p, float), (length, 2)) for p in points], axis=1)


def unit(angle):
    """(cos, sin) of angles (T,)."""
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)


def draw_andrews(left, right):
    """The four chains to the point P; the energy that the motor has supplied."""
    p, (ts, q, v, _) = andrews.params, moved(andrews)
    a, b, c = ([p["x" + k], p["y" + k]] for k in "abc")
    crank = p["rr"] * unit(q.beta)
    P = crank - p["d"] * unit(q.beta + q.theta)
    upper = a + p["zt"] * unit(q.delta)
    lower = a + p["u"] * unit(q.epsilon - np.pi / 2)
    D = np.asarray(b) + p["sd"] * unit(q.gamma) + p["sc"] * unit(q.gamma - np.pi / 2)
    chains = [path([0, 0], crank, P), path(b, P), path(a, upper, P), path(a, lower, P), path(b, D)]
    stills(left, chains, len(ts))
    left.set(title="Seven bodies that meet in P", xlabel="x / m", ylabel="y / m")
    stretch = np.linalg.norm(D - c, axis=1) - p["l0"]
    kinetic = jax.vmap(lambda t, q, v: andrews.system.lagrangian(t, q, v, {**p, "c0": 0.0, "mom": 0.0}))(ts, q, v)
    stored = np.asarray(kinetic) + 0.5 * p["c0"] * stretch**2
    work = p["mom"] * (q.beta - q.beta[0])
    compared(right, ts * 1e3, work * 1e3, (stored - stored[0]) * 1e3, "work of the motor, M β",
             xlabel="t / ms", ylabel="energy / mJ", title="Motion and spring have what the motor gave")  # fmt: skip


def draw_car_axis(left, right):
    """Axle and springs; the slope of the left spring and of the road."""
    p, (ts, q, _, _) = car_axis.params, moved(car_axis, count=301)
    wheel = np.stack(road(ts, p), axis=1)
    l, r = np.stack([q.xl, q.yl], axis=1), np.stack([q.xr, q.yr], axis=1)
    stills(left, [path(l, r), path([0, 0], l), path(wheel, r)], len(ts))
    left.set(title="A stiff axle on two springs", xlabel="x / m", ylabel="y / m")
    # The left spring is at right angles to the road.
    slope = -q.xl / q.yl
    height = np.asarray(p["r"] * np.sin(p["omega"] * ts))
    compared(right, ts, height / np.sqrt(p["L"] ** 2 - height**2), slope, "tan of the road's angle",
             xlabel="t / s", ylabel="-xl / yl", title="The left spring stands upright on the road")  # fmt: skip


def slider(q, left, count):
    """Crank, rod and block."""
    end = 2 * np.stack([q.crank.x, q.crank.y], axis=1)
    stills(left, [path([0, 0], end), path(end, np.stack([q.block, 0 * q.block], axis=1))], count)
    left.set(xlabel="x / m", ylabel="y / m")


def draw_slider_crank(left, right):
    """Thrown and then moving freely: the energy gives the speed of the crank."""
    p, (ts, q, v, _) = slider_crank.params, moved(slider_crank, end=0.05)
    slider(q, left, len(ts))
    left.set(title="Thrown, and left alone")
    s, c, rho = np.sin(q.crank.angle), np.cos(q.crank.angle), p["l1"] / p["l2"]
    s2, w = -rho * s, -rho * c / np.sqrt(1 - (rho * s) ** 2)
    inertia = p["J1"] + p["m1"] * p["l1"] ** 2 / 4 + p["J2"] * w**2
    inertia += p["m2"] * ((p["l1"] * s + p["l2"] * w * s2 / 2) ** 2 + (p["l1"] * c) ** 2 / 4)
    inertia += p["m3"] * (p["l1"] * s + p["l2"] * w * s2) ** 2
    height = 0.5 * (p["m1"] + p["m2"]) * p["g"] * p["l1"] * s
    known = np.sqrt((inertia[0] * v.crank.angle[0] ** 2 - 2 * height) / inertia)
    compared(right, np.degrees(q.crank.angle), known, v.crank.angle, "√(2 (E - V) / J)",
             xlabel="angle of the crank / °", ylabel="its rate / (rad/s)", title="One first integral")  # fmt: skip


def draw_driven_crank(left, right):
    """Driven at a constant rate: the motor's torque is the multiplier of the drive."""
    p, (ts, q, _, multipliers) = driven_crank.params, moved(driven_crank, end=0.0419)
    slider(q, left, len(ts))
    left.set(title="Turned at a constant rate")
    compared(right, np.degrees(q.crank.angle), driven_crank_exact(ts, p)[2], multipliers["motor"], "½ J′Ω² + V′",
             xlabel="angle of the crank / °", ylabel="torque / N m", title="The motor's torque")  # fmt: skip


def draw_n_four_bar(left, right):
    """A ladder that swings through its singular positions."""
    p, (ts, q, v, _) = n_four_bar.params, moved(n_four_bar, end=2.6)
    feet = [np.array([i, 0.0]) for i in range(3)]
    stills(left, [*(path(foot, q[:, i]) for i, foot in enumerate(feet)), path(*q.transpose(1, 0, 2))], len(ts))
    left.set(title="Two windows, over and under", xlabel="x / m", ylabel="y / m")
    phi = np.unwrap(np.arctan2(q[:, 0, 1], q[:, 0, 0]))
    inertia, weight = 2 + 3 / 3, 2 + 3 / 2
    known = 1.0 - 2 * weight / inertia * p["g"] * (np.sin(phi) - 1.0)
    compared(right, ts, np.sqrt(known), np.linalg.norm(v[:, 0], axis=1), "that of a pendulum", xlabel="t / s",
             ylabel="speed of the heads / (m/s)", title="Through 0° and 180° all rods are in line")  # fmt: skip


def draw_bricard(left, right):
    """Six links that move although the count of degrees of freedom says that they cannot."""
    ts, q, _, _ = moved(bricard, end=9.0)
    ends = jax.vmap(lambda q: closed(q, bricard.params))(q)
    points, axes = (np.asarray(x) for x in ends)
    # The view is along (1, 1, 1), turned a little.
    view = np.linalg.qr(np.array([[1.0, 0.9, 1.2], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]]).T)[0][:, 1:]
    loop = np.concatenate([points, points[:, :1]], axis=1) @ view
    stills(left, [loop], len(ts))
    left.set(title="Five rods and the ground", xlabel="seen", ylabel="from one side")
    rods = np.roll(points, -1, axis=1) - points
    before = np.roll(rods, 1, axis=1)
    angles = np.arctan2(
        np.sum(np.cross(before, rods) * axes, axis=2), np.sum(before * rods, axis=2)
    )  # the angle by which r_(i-1) turns into r_i about u_i
    grid = np.linspace(-np.pi, np.pi, 200)
    right.contour(*2 * [np.degrees(grid)], closure(*np.meshgrid(grid, grid)), [0.0], colors=[plots.COLOURS[1]])
    right.plot(*np.degrees(angles[::3, :2]).T, "o", color=plots.COLOURS[0], markersize=3)
    right.set(xlabel="θ / °", ylabel="φ / °", title="cos θ + cos φ + cos θ cos φ = 0")


def draw_governor(left, right):
    """Balls, slider and the spin that carries them."""
    mechanism = MECHANISMS["governor"]
    ts, q, v, _ = moved(mechanism, end=3.0, count=241)
    reach, top = np.hypot(q.C[:, 0], q.C[:, 1]), np.array([0.05, 1.0])
    ball = np.stack([reach, q.C[:, 2]], axis=1)
    stills(left, [path(top, ball), path([-0.05, 1.0], ball * [-1, 1]), path(np.stack([0 * q.z, q.z], axis=1))], len(ts))
    left.set(title="In the plane that turns with the shaft", xlabel="r / m", ylabel="z / m")
    p, momentum = mechanism.params, lj.momentum(mechanism.system, 0.0, mechanism.q0, mechanism.v0, mechanism.params)
    b = p["b"]
    total = momentum.psi + sum(
        float(np.cross(r, m)[2]) for r, m in ((mechanism.q0.C, momentum.C), (mechanism.q0.D, momentum.D))
    )
    inertia = p["I"] + 2 * p["ball"] * reach**2 + 2 * p["rod"] * (b**2 + b * reach + reach**2) / 3
    compared(right, ts, total / inertia, v.psi, "p / J(r)", xlabel="t / s", ylabel="rate of the shaft / (rad/s)",
             title="The angular momentum stays")  # fmt: skip


def draw_double_pendulum(left, right):
    """Released at rest, both rods level."""
    mechanism = MECHANISMS["double_pendulum"]
    ts, q, v, _ = moved(mechanism)
    stills(left, [path([0, 0], q.r1, q.r2)], len(ts))
    left.plot(*q.r2.T, color=plots.COLOURS[1], linewidth=0.8)
    left.set(title="Two masses on rods", xlabel="x / m", ylabel="y / m")
    kinetic = 0.5 * np.sum(v.r1**2, axis=1) + 0.5 * np.sum(v.r2**2, axis=1)
    compared(right, ts, -9.81 * (q.r1[:, 1] + q.r2[:, 1]), kinetic, "-g (m1 y1 + m2 y2)", xlabel="t / s",
             ylabel="kinetic energy / J", title="What was height is motion")  # fmt: skip


def draw_fekete(left, right):
    """Twenty particles push each other apart until they rest."""
    ts, q, _, multipliers = moved(MECHANISMS["fekete"], end=20.0)
    left.plot(*unit(np.linspace(0, 2 * np.pi, 181)).T, color="black", linewidth=0.8)
    for k in range(20):
        left.plot(q[:, k, 0], q[:, k, 1], color=plots.COLOURS[k % 5], linewidth=0.8)
    left.plot(*q[-1, :, :2].T, "o", color="black", markersize=4)
    left.set(title="From four rings to rest, from above", aspect="equal", xlabel="x", ylabel="y")
    right.plot(ts, multipliers["sphere"], color=plots.COLOURS[0], linewidth=0.8)
    right.axhline(-19 / 4, label="-(N - 1)/4", **plots.style(1))
    right.set(xlabel="t", ylabel="multipliers", title="At rest all are equal")
    right.legend(fontsize=8, frameon=False)


def draw_woodpecker():
    """One lap of the toy, and the beginning of the next."""
    ts = np.linspace(0.0, 0.18, 721)
    traj = woodpecker.motion(woodpecker.PARAMS, ts, rtol=1e-8, estimate_error=False)
    fig, axes = plots.figure(1, 2, size=(4.6, 3.4))
    left, right = axes[0]
    left.plot(ts, 1e3 * traj.q["y"], **plots.style(0))
    left.set(xlabel="t / s", ylabel="height of the sleeve / mm", title="One lap of 0.146 s: 19.4 mm down")
    for i, (name, label) in enumerate((("sleeve", "sleeve"), ("bird", "bird"))):
        right.plot(ts, np.degrees(traj.q[name]), label=label, **plots.style(i))
    known = np.degrees((woodpecker.PARAMS["r_M"] - woodpecker.PARAMS["r_0"]) / woodpecker.PARAMS["h_M"])
    for sign in (1, -1):
        right.axhline(
            sign * known, color="black", linewidth=0.8, label="±(r_M - r_0)/h_M: jammed" if sign > 0 else None
        )
    right.set(xlabel="t / s", ylabel="angle / °", title="A sleeve that jams and a bird that swings")
    right.legend(fontsize=8, frameon=False)
    return fig


def draw_open_joint():
    """A crank and a rod in a rough drawing, with frames."""
    y = (0.0, 1.0, 0.0)
    crank, rod = lj.bodies.Body("crank", 1.0, (0.1, 0.1, 0.01)), lj.bodies.Body("rod", 1.0, (0.3, 0.3, 0.01))
    joints = {
        "axle": lj.bodies.revolute(lj.bodies.ground.at(axis=y), crank.at((0.0, 0.0, -0.5), y)),
        "pin": lj.bodies.revolute(crank.at((0.0, 0.0, 0.5), y), rod.at((0.0, 0.0, -1.0), y)),
    }
    rough = {
        "crank": lj.bodies.Pose.at((0.0, 0.0, 0.5)),
        "rod": lj.bodies.Pose.at((1.0, 0.0, 1.3), axis=y, angle=np.pi / 2),
    }
    return lj.draw(lj.bodies.multibody([crank, rod], joints), rough, frames=True).figure()


def draw_spinning_top():
    """A top on its tip, let go with its axis at rest: it nods between two angles and precesses."""
    top = lj.bodies.Body("top", mass=1.0, inertia=(0.1, 0.1, 0.05))
    tip = lj.bodies.spherical(lj.bodies.ground.at(), top.at((0.0, 0.0, -0.5)))
    system = lj.bodies.multibody([top], {"tip": tip}, [lj.bodies.weight([top])])
    start = lj.bodies.Pose.at().turned((0.0, 1.0, 0.0), TILT)
    axis = top.direction({"top": start}, (0.0, 0.0, 1.0))
    start = start._replace(position=0.5 * axis)
    q, v = {"top": start}, {"top": start.moving(spin=80.0 * axis)}
    traj = lj.integrate(system, q, v, ts=np.linspace(0.0, 4.3, 431), rtol=1e-8, estimate_error=False)
    heights = np.asarray(jax.vmap(lambda q: top.direction(q, (0.0, 0.0, 1.0))[2])(traj.q))
    # Goldstein, Eq. 5.75: x² + p x - q = 0, with a = I_3 ω/I_1, β = 2 m g l/I_1 about the tip.
    a, beta = 0.05 * 80.0 / 0.35, 2 * 9.81 * 0.5 / 0.35
    p = a**2 / beta - 2 * np.cos(TILT)
    dip = (np.sqrt(p**2 + 4 * np.sin(TILT) ** 2) - p) / 2
    print("lowest height", heights.min(), "known", np.cos(TILT) - dip)
    end = top.at((0.0, 0.0, 0.3))
    shapes = [
        lj.shapes.cylinder(top, 0.3, 0.04, color=plots.COLOURS[0]),
        lj.shapes.rod(top.at((0.0, 0.0, -0.5)), end, 0.02, color=plots.COLOURS[1]),
        lj.shapes.trail(end, color=plots.COLOURS[2]),
        lj.shapes.line(lj.bodies.ground),
    ]
    return traj.draw(shapes, times=[0.0, 1.4, 2.8], view=(-60.0, 24.0))


def picture(name):
    """The figure of a scene or mechanism."""
    if name in SCENES:
        return SCENES[name].picture()
    if name in ("woodpecker", "spinning_top", "open_joint"):
        return globals()[f"draw_{name}"]()
    fig, axes = plots.figure(1, 2, size=(4.6, 3.4))
    globals()[f"draw_{name}"](*axes[0])
    return fig


def save(fig, file):
    """Write a picture, reduced to a palette."""
    written = io.BytesIO()
    fig.savefig(written, format="png", dpi=100)
    image = Image.open(written).convert("RGB")
    image.quantize(COLOURS, dither=Image.Dither.NONE).save(file, "png", optimize=True)


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for name in sys.argv[1:] or [*SCENES, "woodpecker", *MECHANISMS, "spinning_top", "open_joint"]:
        save(picture(name), FOLDER / f"{name}.png")
        print(name, (FOLDER / f"{name}.png").stat().st_size, flush=True)
