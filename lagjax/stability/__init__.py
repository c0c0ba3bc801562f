"""The stability report: hard cases, each of which is accurate, degraded with a warning, or refused with a reason.

`python -m lagjax stability` prints it: masses, angles, speeds, stiffness, amplitudes, time spans and precisions at the
ends of their ranges, each compared with a closed form or an independent value.
"""

from lagjax.stability.rows import trials
from lagjax.stability.trial import FULL, QUICK, REDUCED, SILENTLY_WRONG, VERDICTS, Outcome, Trial, stability_table

__all__ = ["FULL", "QUICK", "REDUCED", "SILENTLY_WRONG", "VERDICTS", "Outcome", "Trial", "stability_table", "trials"]
