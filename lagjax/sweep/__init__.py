"""Sweeps: run one function over a grid of points on all cores and devices, labelled and resumable."""

from lagjax.sweep.axes import axes_of
from lagjax.sweep.engine import LAYOUTS, TRUSTED, Status, program_for, usable_cores
from lagjax.sweep.result import MOST_CURVES, Drawn, Sweep, drawn, open_sweep
from lagjax.sweep.sweep import sweep
