"""Branches of equilibria and orbits."""

from lagjax.analysis.continuation.equilibria import continue_equilibria
from lagjax.analysis.continuation.orbit_result import CriticalOrbit, OrbitBranch
from lagjax.analysis.continuation.orbits import continue_orbits
from lagjax.analysis.continuation.result import Branch, Branches, Critical
