"""Small motions."""

from lagjax.analysis.modes.linearise import Linearisation, linearise
from lagjax.analysis.modes.normal_modes import Mode, NormalModes, normal_modes
