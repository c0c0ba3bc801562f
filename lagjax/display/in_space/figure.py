"""Several instants of a motion in space in one figure, for papers. Needs matplotlib (`pip install "lagjax[plot]"`)."""

import numpy as np

from lagjax.display.in_space.painting import Mark, marks, surroundings, trails
from lagjax.display.in_space.scenery import InSpace
from lagjax.display.in_space.view import WIDTH, view_of
from lagjax.display.plots import figure, names_as_they_are

# Inches per pixel, and points per pixel: the widths of a figure for a column.
INCHES, POINTS = 1 / 96, 0.75
# How much white is mixed into the first of several instants.
PALEST = 0.8
# The width of a face's own edge, which covers the seam to its neighbour.
SEAM = 0.6


@names_as_they_are()
def stills_in_space(motion: InSpace, chosen: InSpace, azimuth: float, elevation: float):
    """Draw some instants of a motion in one figure, earlier ones paler, and the paths of trails over all of it.

    **Arguments:** `motion`: its frames, which are the picture's size; `chosen`: those drawn; `azimuth`, `elevation`: of
    the eye, in degrees.

    **Returns:** a matplotlib `Figure`.
    """
    view, grid = view_of(*motion.extent(), azimuth, elevation)
    fig, axes = figure(size=(WIDTH * INCHES, view.height * INCHES))
    axis = axes[0, 0]
    axis.set(xlim=(0.0, WIDTH), ylim=(view.height, 0.0), aspect="equal")
    axis.set_axis_off()
    count = len(next(iter((chosen.poses | chosen.points).values())))
    painted = trails(motion, view)
    for i in range(count):
        painted += marks(chosen.at(i), view, PALEST * (1 - i / (count - 1)) if count > 1 else 0.0)
    around, painted = surroundings(grid, view), sorted(painted, key=lambda mark: mark.nearness)
    # Seen from below, the floor is in front.
    found = [*around, *painted] if elevation >= 0 else [*painted, *around]
    _paint(axis, [mark for mark in found if not mark.text])
    for mark in found:
        if mark.text:
            axis.text(*mark.at[0], mark.text, fontsize=8, ha=mark.align, va="center", color=mark.color)
    return fig


def _paint(axis, found: list[Mark]):
    """All in one collection, which matplotlib draws in the order given."""
    from matplotlib.collections import PathCollection
    from matplotlib.path import Path

    turn = np.linspace(0.0, 2 * np.pi, 25)
    circle = np.stack([np.cos(turn), np.sin(turn)], axis=1) / 2
    paths = [Path(mark.at + mark.width * circle if len(mark.at) == 1 else mark.at) for mark in found]
    axis.add_collection(
        PathCollection(
            paths,
            facecolors=[(*mark.color, 0.0 if len(mark.at) == 2 else 1.0) for mark in found],
            edgecolors=[mark.color for mark in found],
            linewidths=[mark.width * POINTS if len(mark.at) == 2 else SEAM for mark in found],
            capstyle="round",
            joinstyle="round",
        )
    )
