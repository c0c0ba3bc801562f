"""Sweeps: run one function over a grid of points on all cores and devices, labelled and resumable."""

from lagjax.sweep.axes import axes_of
from lagjax.sweep.batch_program import LAYOUTS, TRUSTED, Status, program_for
from lagjax.sweep.result import Sweep, open_sweep
from lagjax.sweep.scheduler import usable_cores
from lagjax.sweep.sweep import sweep
from lagjax.sweep.web_page import MOST_CURVES, Drawn, drawn
