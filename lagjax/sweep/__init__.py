"""Sweeps: run one function over a grid of points on all cores and devices, labelled and resumable."""

from lagjax.sweep.batch_program import Status
from lagjax.sweep.result import Sweep, open_sweep
from lagjax.sweep.sweep import sweep

__all__ = ["sweep", "Sweep", "Status", "open_sweep"]
