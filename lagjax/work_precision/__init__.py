"""Error against run time and against evaluations, of several methods on one motion."""

from lagjax.work_precision.methods import usual_methods, usual_others
from lagjax.work_precision.result import WorkPrecision, in_ms
from lagjax.work_precision.work_precision import Horizons, horizons, work_precision
