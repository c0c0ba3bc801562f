"""Films in a file of pixels: GIF by Pillow, MP4 by ffmpeg, painted frame after frame by matplotlib."""

from collections.abc import Callable
from pathlib import Path
from shutil import which
from typing import Any

import numpy as np

from lagjax.display.painting import AZIMUTH, ELEVATION, WIDTH, marks, painted_in, surroundings, trails, view_of
from lagjax.display.plots import COLOURS, figure, import_matplotlib, names_as_they_are
from lagjax.display.scenery import InSpace

# The width of the picture in inches; its dots per inch by what reads the file: a GIF has no compression worth its name.
INCHES = 5.4
SUFFIXES = {".gif": 100, ".mp4": 180}
# Points of longer lines are not marked: such lines are outlines.
MARKED_UP_TO = 8


def write(path: Path, t: np.ndarray, points: "dict[str, np.ndarray] | InSpace", rate: float, trail: int) -> None:
    """Write a film as GIF or MP4, by the suffix of its path; arguments as those of `Animation`.

    **Raises:** `ImportError` without matplotlib; `ValueError` for MP4 without ffmpeg.
    """
    matplotlib, suffix = import_matplotlib(), path.suffix.lower()
    from matplotlib.animation import FFMpegWriter, PillowWriter

    if not isinstance(points, InSpace) and next(iter(points.values())).shape[-1] == 3:
        points = InSpace((), {}, points)
    settings = {"animation.ffmpeg_path": _ffmpeg(path)} if suffix == ".mp4" else {}
    writer = PillowWriter(rate) if suffix == ".gif" else FFMpegWriter(rate, extra_args=["-pix_fmt", "yuv420p"])
    digits = max(0, int(np.ceil(-np.log10(abs(float(t[1] - t[0]))))))
    with names_as_they_are(), matplotlib.rc_context(settings):
        fig, paint = _in_space(points, trail) if isinstance(points, InSpace) else _in_plane(points, trail)
        clock = fig.text(0.99, 0.01, "", ha="right", va="bottom", fontsize=9, color="#333333")
        # Laid out once: to do it for each frame takes most of the time, and would move the axes.
        paint(0)
        fig.draw_without_rendering()
        fig.set_layout_engine("none")
        with writer.saving(fig, str(path), SUFFIXES[suffix]):
            for i, now in enumerate(t):
                paint(i)
                clock.set_text(f"t = {now:.{digits}f}")
                writer.grab_frame()


def _ffmpeg(path: Path) -> str:
    """The program that writes MP4: on the path, or that of imageio-ffmpeg; or raise."""
    if found := which("ffmpeg"):
        return found
    try:
        import imageio_ffmpeg  # pyright: ignore[reportMissingImports]

        return imageio_ffmpeg.get_ffmpeg_exe()
    except (ImportError, RuntimeError):
        raise ValueError(
            f"'{path.name}' needs ffmpeg, which is not on this machine.\n"
            f'Fix: pip install imageio-ffmpeg, or the ffmpeg of the system; or .save("{path.stem}.gif"), or '
            f'.save("{path.stem}.html"), which plays in any browser.'
        ) from None


def _in_plane(points: dict[str, np.ndarray], trail: int) -> tuple[Any, Callable[[int], None]]:
    """A figure, and what paints one frame of points (F, k, 2) in it."""
    # The same field as that of the page.
    every = np.concatenate([x.reshape(-1, 2) for x in points.values()])
    low, high = every.min(axis=0), every.max(axis=0)
    size = np.maximum(high - low, 0.3 * np.max(high - low))
    size = 1.1 * np.where(size > 0, size, 1.0)
    low = (low + high - size) / 2
    fig, axes = figure(size=(INCHES, float(np.clip(INCHES * size[1] / size[0], 2.0, 4.6))))
    axis, drawn = axes[0, 0], []
    axis.set(xlim=(low[0], low[0] + size[0]), ylim=(low[1], low[1] + size[1]), aspect="equal", xlabel="x", ylabel="y")
    for i, (name, frames) in enumerate(points.items()):
        color = COLOURS[i % len(COLOURS)]
        marker = "o" if frames.shape[1] <= MARKED_UP_TO else ""
        (behind,) = axis.plot([], [], color=color, linewidth=1.0, alpha=0.45)
        (line,) = axis.plot([], [], marker=marker, color=color, linewidth=1.6, label=name)
        drawn.append((frames, behind, line))
    if len(points) > 1:
        axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))

    def paint(i: int) -> None:
        for frames, behind, line in drawn:
            behind.set_data(*frames[max(0, i - trail) : i + 1, -1].T)
            line.set_data(*frames[i].T)

    return fig, paint


def _in_space(motion: InSpace, trail: int) -> tuple[Any, Callable[[int], None]]:
    """A figure, and what paints one frame of a motion in it."""
    view, grid = view_of(*motion.extent(), AZIMUTH, ELEVATION)
    fig, axes = figure(size=(INCHES, INCHES * view.height / WIDTH))
    around = surroundings(grid, view)

    def paint(i: int) -> None:
        axis = axes[0, 0]
        axis.clear()
        behind = trails(motion.at(slice(max(0, i - trail), i + 1)), view)
        found = sorted([*behind, *marks(motion.at(i), view)], key=lambda mark: mark.nearness)
        painted_in(axis, [*around, *found], view)

    return fig, paint
