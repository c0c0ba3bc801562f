"""The stability report: hard cases, each of which is accurate, degraded with a warning, or refused with a reason.

`python -m lagjax stability` prints it: masses, angles, speeds, stiffness, amplitudes, time spans and precisions at the
ends of their ranges, each compared with a closed form or an independent value.
"""

from dataclasses import replace

from lagjax.report import FULL, MAIN, QUICK
from lagjax.stability.closed_forms import bead, float32, geodesics, long, redundant, separatrix, wedge
from lagjax.stability.stiff_and_chaotic import amplifying, stable_steps, stiff
from lagjax.stability.trial import SILENTLY_WRONG, VERDICTS, Outcome, Trial, stability_table

__all__ = ["FULL", "QUICK", "MAIN", "SILENTLY_WRONG", "VERDICTS", "Outcome", "Trial", "stability_table", "trials"]

FAMILIES = (wedge, bead, separatrix, long, stiff, stable_steps, geodesics, amplifying, float32, redundant)


def trials(tier=FULL):
    """The rows of the QUICK, MAIN or FULL tier."""
    rows = [row for family in FAMILIES for row in family() if row.tier <= tier]
    return [replace(row, along=None) if isinstance(row, Trial) and row.derived_in > tier else row for row in rows]
