"""A picture of multipliers in the complex plane."""

import numpy as np

from lagjax.display import plots

# The largest extent of the axes: beyond this the circle would be too small to see.
FAR = 4.0


def unit_circle(multipliers: np.ndarray, trivial: np.ndarray):
    """Draw multipliers (k,) as dots, trivial ones hollow, with the unit circle; returns a matplotlib `Figure`.

    Multipliers far outside are drawn at the edge, with their values.
    """
    fig, axes = plots.figure(size=(4.2, 4.0))
    axis, turn = axes[0, 0], np.linspace(0.0, 2 * np.pi, 361)
    axis.fill(np.cos(turn), np.sin(turn), color="0.93", zorder=0)
    axis.plot(np.cos(turn), np.sin(turn), color=plots.COLOURS[-1], linewidth=1.0)
    size = np.abs(multipliers)
    reach = 1.2 * min(FAR, max(1.0, size[np.isfinite(size)].max(initial=1.0)))
    shown = multipliers * np.minimum(1.0, 0.96 * reach / np.maximum(size, 1e-300))
    outside = size > 1 + 1e-6
    axis.plot(*_parts(trivial), "o", markersize=10, markerfacecolor="none", color=plots.COLOURS[-1], label="trivial")
    for which, colour, label in (
        (~outside, plots.COLOURS[0], "inside or on it"),
        (outside, plots.COLOURS[1], "outside"),
    ):
        if which.any():
            axis.plot(*_parts(shown[which]), "o", markersize=5, color=colour, label=label)
    for x, at, far in zip(multipliers, shown, size > reach):
        if far:
            axis.annotate(f"{x.real:.3g}" + (f" {x.imag:+.3g}i" if x.imag else ""), (at.real, at.imag), (0, 8),
                          textcoords="offset points", ha="center", fontsize=8, bbox=plots.ON_MARKS)  # fmt: skip
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="Re μ", ylabel="Im μ")
    axis.legend(fontsize=8, frameon=False, loc="upper left")
    return fig


def _parts(numbers):
    return np.real(numbers), np.imag(numbers)
