"""Parameters from measured motion."""

from lagjax.fit.fit import fit
from lagjax.fit.identifiability import identifiability
from lagjax.fit.load import load_fit
from lagjax.fit.loss import FitFunction, fit_loss, fit_residuals
from lagjax.fit.problem.arguments import FitWarning
from lagjax.fit.problem.records import Record
from lagjax.fit.result.result import Fit
from lagjax.fit.uncertainty.identifiable import Identifiability
