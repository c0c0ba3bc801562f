"""The README's figure: forces of constraints, a sweep, a fit; `python docs/overview.py` writes `docs/overview.png`."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.display import plots
from lagjax.scenes import bead_on_hoop, rolling_hoop

jax.config.update("jax_enable_x64", True)


def hoop(axis):
    """Forces on a hoop that rolls off a cylinder, until it lets go, with Goldstein's formulas."""
    params, ts = rolling_hoop.PARAMS, np.linspace(0.0, 2.4, 121)
    motion = rolling_hoop.roll(params, 1.45, 0.0, ts)
    angle = np.degrees(np.asarray(motion.q["theta"]))
    exact = rolling_hoop.exact_multipliers(params, motion.q["theta"], 1.45)
    for i, (name, label) in enumerate((("contact", "normal force"), ("rolling", "friction"))):
        axis.plot(angle, motion.multipliers[name], label=label, **plots.style(i))
        axis.plot(angle[::6], getattr(exact, name)[::6], "o", color=plots.COLOURS[i], markersize=3)
    axis.axvline(np.degrees(np.arcsin(rolling_hoop.departure_sine(params, 1.45))), color="black", linewidth=0.8)
    axis.set(xlabel="angle of the hoop / °", ylabel="force / N", title="Multipliers are forces (dots: exact)")
    axis.invert_xaxis()


def pitchfork(axis):
    """The angle at which a damped bead on a rotating hoop comes to rest, over the speed, with the equilibrium angle."""
    params = bead_on_hoop.PARAMS | {"b": 2.0}
    critical = float(bead_on_hoop.natural_rate(params))

    def rest(point):
        with_speed = params | {"omega": point["omega"] * critical}
        return lj.integrate(bead_on_hoop.damped_system, point["start"], 0.0, with_speed, ts=np.array([0.0, 60.0])).q[-1]

    speeds = np.linspace(0.3, 3.0, 55)
    swept = lj.sweep(rest, {"omega": speeds, "start": np.array([-0.1, 0.1])}, progress=False)
    axis.plot(speeds, swept.values, "o", color=plots.COLOURS[0], markersize=3)
    above = np.linspace(1.0, 3.0, 200)
    for sign in (-1, 1):
        axis.plot(above, sign * np.arccos(1 / above**2), label="arccos(ω0²/ω²)" if sign > 0 else None, **plots.style(1))
    axis.set(xlabel="ω / ω0", ylabel="angle at rest / rad", title="Sweeps: a bead on a rotating hoop")


def fitted(axis):
    """A swing with friction, measured with errors and a gap, and its fit by `lj.fit`."""
    swing = lj.System(
        lambda t, q, v, p: 0.5 * v**2 + p["w2"] * jnp.cos(q), dissipation=lambda t, q, v, p: 0.5 * p["c"] * v**2
    )
    ts = np.linspace(0.0, 10.0, 121)
    clean = np.asarray(lj.integrate(swing, 2.0, 0.0, {"w2": 4.0, "c": 0.1}, ts=ts).q)
    data = clean + 0.05 * np.random.default_rng(0).normal(size=ts.size)
    data[50:75] = np.nan
    found = lj.fit(swing, lj.Record(ts, q=data, sigma=0.05), {"w2": 3.0, "c": 0.3})
    axis.plot(ts, data, ".", color="#888888", markersize=3, label="measured")
    fine = np.linspace(0.0, 10.0, 400)
    label = ", ".join(f"{n} = {x:.3f} ± {s:.3f}" for n, x, s in zip(("c", "ω²"), found.values, found.sd))
    axis.plot(fine, found.motion(ts=fine).q, label=label, **plots.style(1))
    axis.set(xlabel="t / s", ylabel="angle / rad", title="Fits, with their uncertainty", ylim=(-2.0, 3.4))


def main(path):
    """Draw and write."""
    fig, axes = plots.figure(1, 3, size=(4.2, 3.0))
    for axis, draw in zip(axes[0], (hoop, pitchfork, fitted)):
        draw(axis)
        axis.legend(fontsize=8, frameon=False)
    fig.savefig(path, dpi=100)


if __name__ == "__main__":
    main(Path(__file__).with_suffix(".png"))
