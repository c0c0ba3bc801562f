"""Parameters from measured motion."""

from lagjax.fit.arguments import FitWarning
from lagjax.fit.fit import FitFunction, fit, fit_loss, fit_residuals, load_fit
from lagjax.fit.records import Record
from lagjax.fit.result import Fit
from lagjax.fit.uncertainty import Identifiability, identifiability
