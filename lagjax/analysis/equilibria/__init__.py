"""Rest and steady motion."""

from lagjax.analysis.equilibria.equilibria import equilibria
from lagjax.analysis.equilibria.result import Equilibria
