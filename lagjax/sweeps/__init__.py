"""Sweeps: one function over a grid of points, on all cores and devices, labelled and resumable."""

from lagjax.sweeps.lanes import Status
from lagjax.sweeps.result import Sweep, open_sweep
from lagjax.sweeps.sweep import sweep

__all__ = ["sweep", "Sweep", "Status", "open_sweep"]
