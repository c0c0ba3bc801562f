"""Symmetries and what they conserve."""

from lagjax.analysis.symmetry.is_symmetry import SymmetryTest, is_symmetry
from lagjax.analysis.symmetry.result import Symmetries
from lagjax.analysis.symmetry.search import symmetries
