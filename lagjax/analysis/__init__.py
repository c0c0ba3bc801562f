"""What a system is like."""

from lagjax.analysis.continuation import (
    Branch,
    Branches,
    Critical,
    CriticalOrbit,
    OrbitBranch,
    continue_equilibria,
    continue_orbits,
)
from lagjax.analysis.energy import EnergyLedger, energy_ledger
from lagjax.analysis.equilibria import Equilibria
from lagjax.analysis.explain import Explanation, HybridExplanation, explain
from lagjax.analysis.formulations import EquationsOfMotion, Hamiltonian, Routhian
from lagjax.analysis.modes import Linearisation, Mode, NormalModes
from lagjax.analysis.orbits import Floquet, LyapunovExponents, OrbitWarning, PeriodicOrbit, lyapunov_exponents
from lagjax.analysis.poincare import PoincareSection, periods, poincare, turning_points
from lagjax.analysis.symmetry import Symmetries, SymmetryTest, symmetries
