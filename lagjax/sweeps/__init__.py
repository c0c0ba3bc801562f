"""Sweeps: run one function over a grid of points on all cores and devices, labelled and resumable."""

from lagjax.sweeps.engine import sweep
from lagjax.sweeps.lanes import Status
from lagjax.sweeps.result import Sweep, open_sweep

__all__ = ["sweep", "Sweep", "Status", "open_sweep"]
