"""Pictures of modes: their roots in the plane of growth and frequency, their shapes, and films of their motion."""

from collections.abc import Callable

import jax
import numpy as np

from lagjax.display import plots
from lagjax.display.animation import Animation
from lagjax.integrate.trajectory.drawing import drawn
from lagjax.system import coordinates
from lagjax.system.user_errors import Call, check_arguments

# The length of a film in periods, or in times of growth by a factor e.
PERIODS, GROWTHS = 3.0, 3.0


@plots.names_as_they_are()
def drawn_roots(roots: np.ndarray, growing: np.ndarray, zero: np.ndarray):
    """Draw numbered roots in the complex plane; returns a matplotlib `Figure`."""
    fig, axes = plots.figure(size=(5.6, 3.6))
    axis = axes[0, 0]
    axis.axvline(0.0, color="black", linewidth=0.8)
    axis.axhline(0.0, color="black", linewidth=0.8)
    groups = (("grows", growing, 1, 6), ("zero", zero, 6, 2), ("does not grow", ~growing & ~zero, 0, 0))
    for label, which, colour, marker in groups:
        x = roots[which]
        if x.size:
            both = np.concatenate([x, np.conj(x[np.imag(x) > 0])])
            style = {"color": plots.COLOURS[colour], "marker": plots.MARKERS[marker], "markersize": 6}
            axis.plot(np.real(both), np.imag(both), linestyle="", label=label, zorder=3, **style)
    places: dict[tuple, list[str]] = {}
    size = max(float(np.max(np.abs(roots), initial=0.0)), 1e-300)
    for i, root in enumerate(roots):
        places.setdefault((round(root.real / size, 3), round(root.imag / size, 3)), []).append(str(i))
    for (x, y), names in places.items():
        axis.annotate(", ".join(names), (x * size, y * size), (6, 5), textcoords="offset points", fontsize=8)
    reach = 1.15 * size
    axis.set(xlabel="growth [1/t]", ylabel="frequency [rad/t]", ylim=(-reach, reach))
    if np.all(np.abs(np.real(roots)) < 0.05 * size):
        axis.set_xlim(-0.5 * reach, 0.5 * reach)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


@plots.names_as_they_are()
def drawn_mode(mode):
    """Draw the amplitude and the motion of each coordinate; returns a matplotlib `Figure`."""
    names = mode.linearisation.names
    shape = np.concatenate([np.ravel(np.asarray(x)) for x in jax.tree.leaves(mode.shape)])
    root = complex(mode.root)
    fig, axes = plots.figure(1, 2, size=(4.2, max(2.4, 0.3 * len(names) + 1.2)))
    bars, curves = axes[0]
    place = np.arange(len(names))[::-1]
    bars.barh(place, np.abs(shape), color=[plots.COLOURS[i % len(plots.COLOURS)] for i in range(len(names))])
    bars.set_yticks(place, names)
    bars.set(xlabel="amplitude, the largest one", title=mode.label, xlim=(0.0, 1.25))
    for y, x in zip(place, shape):
        if abs(x) > 1e-6:
            bars.text(
                abs(x) + 0.02,
                y,
                f"{abs(np.degrees(np.angle(x)).round()):.0f}°"
                if x.imag == 0
                else f"{np.degrees(np.angle(x)).round() + 0:.0f}°",
                va="center",
                fontsize=8,
            )
    t = np.linspace(0.0, _span(root), 241)
    moving = np.exp(root * t)
    for i, x in enumerate(shape):
        if abs(x) > 1e-3:
            curves.plot(t, (x * moving).real, label=names[i], **plots.style(i))
    curves.set(xlabel="t", ylabel="displacement", title=_in_words(root))
    curves.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def _in_words(root):
    return f"growth {root.real:.5g}, frequency {root.imag:.5g}"


def _span(root):
    """The time for which a mode is shown."""
    if abs(root.imag) > 0:
        periods = PERIODS * 2 * np.pi / abs(root.imag)
        return min(periods, GROWTHS / abs(root.real)) if abs(root.real) * periods > 2 * GROWTHS else periods
    return GROWTHS / abs(root.real) if root.real else 1.0


def animated(mode, positions: Callable, amplitude: float, seconds: float, rate: float, trail: float) -> Animation:
    """A film of the motion with a mode of this amplitude added."""
    check_arguments(Call("positions", positions, ("t", "q", "params")), "an argument left out that is not needed")
    count = round(seconds * rate) + 1 if np.isfinite(seconds * rate) else 0
    if count < 3 or not trail >= 0:
        raise ValueError(
            f"seconds = {seconds:g} at rate = {rate:g} frames a second, with a trail of {trail:g} s, is not a film.\n"
            "Fix: mode.animate(positions, seconds=6.0), and a trail of zero or more seconds."
        )
    s = mode.linearisation.state
    flat = lambda tree: np.concatenate([np.ravel(np.asarray(x)) for x in jax.tree.leaves(tree)])
    t = np.linspace(0.0, _span(complex(mode.root)), count)
    growing = np.exp(complex(mode.root) * t)
    growing = amplitude * growing / np.max(np.abs(growing))
    if complex(mode.root) == 0:
        # A shift is shown as one oscillation.
        growing = amplitude * np.sin(2 * np.pi * t / t[-1]).astype(complex)
    path = flat(s.q) + t[:, None] * flat(s.v) + np.real(growing[:, None] * flat(mode.shape))
    q = coordinates.like(s.q, path)
    at = float(s.t) + t
    return Animation(at, drawn(positions, at, q, s.params), rate, int(min(trail * rate, count)))
