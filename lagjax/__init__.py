"""lagjax: a differentiable Lagrangian integrator.

Write a Lagrangian as a plain JAX function `L(t, q, v, params)`; everything else follows from it. The names below
are in the order of the physics. Worked systems are in `lagjax.scenes`.

    M a = F + Aᵀ λ      M = ∂²L/∂v∂v,   F = ∂L/∂q - ∂p/∂t - (∂p/∂q) v + Q - ∂R/∂v,   p = ∂L/∂v
    A a = gamma         A = ∂g/∂q (holonomic g = 0) or ∂phi/∂v (velocity constraint phi = 0)

λ > 0 pushes along +∂g/∂q; `R = ½ c v²` gives the force `-c v`; `jacobi_integral` is `v·p - L`, which is
T + V only for natural, time-independent coordinates.
"""

from importlib import import_module
from typing import TYPE_CHECKING

# isort: split
# A system: its Lagrangian and its constraints.
from lagjax.mechanics.constraints import Holonomic, Nonholonomic
from lagjax.mechanics.generators import Generator
from lagjax.mechanics.hybrid import Hybrid, Switch
from lagjax.mechanics.noether import NoetherCharge, noether_charge
from lagjax.mechanics.system import System

# isort: split
# One state: quantities from the Lagrangian and the constraints.
from lagjax.mechanics.lagrangian import jacobi_integral, mass_matrix, momentum
from lagjax.mechanics.multipliers import accelerations, constraint_force, constraint_residual
from lagjax.motion.consistent_state import consistent_state
from lagjax.motion.explanation import Explanation, explain

# isort: split
# Motion.
from lagjax.animation import Animation
from lagjax.mechanics.single_precision import PrecisionWarning
from lagjax.motion.contacts import releases, slips, sticks, touches
from lagjax.motion.crossings import Crossing, Crossings, EventWarning
from lagjax.motion.hybrid_trajectory import HybridTrajectory, Switches
from lagjax.motion.integrate import integrate
from lagjax.motion.ledger import EnergyLedger, energy_ledger
from lagjax.motion.over_jumps import JumpWarning
from lagjax.motion.phase_graph import HybridExplanation
from lagjax.motion.replay import Replay
from lagjax.motion.results import RESULTS
from lagjax.motion.saved import load_trajectory
from lagjax.motion.sections import PoincareSection, periods, poincare, turning_points
from lagjax.motion.trajectory import AccuracyWarning, Snapshot, Trajectory
from lagjax.numerics.nystrom import Nystrom8, Nystrom12
from lagjax.numerics.radau import Radau5
from lagjax.numerics.runge_kutta import Dopri8, Tsit5

# isort: split
# Many motions.
from lagjax.pages.page import Page
from lagjax.sweeps.engine import sweep
from lagjax.sweeps.lanes import Status
from lagjax.sweeps.result import Sweep, open_sweep

# isort: split
# From measured motion.
from lagjax import learned
from lagjax.fitting.asked import identifiability
from lagjax.fitting.engine import fit
from lagjax.fitting.identifiability import Identifiability
from lagjax.fitting.records import Record
from lagjax.fitting.result import Fit, FitWarning
from lagjax.fitting.saved import load_fit

# isort: split
# Error against run time.
from lagjax.comparison.diagram import WorkPrecision
from lagjax.comparison.work_precision import work_precision

if TYPE_CHECKING:
    from lagjax import scenes

    # Analysis of a system.
    from lagjax.analysis.branches import Branch, Branches, Critical
    from lagjax.analysis.continuation import continue_equilibria
    from lagjax.analysis.continued_orbits import continue_orbits
    from lagjax.analysis.cycles import OrbitWarning, periodic_orbit
    from lagjax.analysis.equilibria import equilibria
    from lagjax.analysis.floquet import Floquet, floquet
    from lagjax.analysis.found import Symmetries
    from lagjax.analysis.found_equilibria import Equilibria
    from lagjax.analysis.hamilton import Hamiltonian, hamiltonian
    from lagjax.analysis.latex import EquationsOfMotion, latex
    from lagjax.analysis.least_action import action
    from lagjax.analysis.linearised import Linearisation, linearise
    from lagjax.analysis.lyapunov import LyapunovExponents, lyapunov_exponents
    from lagjax.analysis.modes import Mode, NormalModes, normal_modes
    from lagjax.analysis.orbit import PeriodicOrbit
    from lagjax.analysis.orbit_branch import CriticalOrbit, OrbitBranch
    from lagjax.analysis.routh import Routhian, routhian
    from lagjax.analysis.symmetries import symmetries
    from lagjax.analysis.symmetry import SymmetryTest, is_symmetry

    # Import and export.
    from lagjax.exchange.from_sympy import from_sympy
    from lagjax.exchange.standalone_programs import export, result_codes

    # Many motions, in a notebook.
    from lagjax.interactive.interact import Knobs, interact


__version__ = "0.2.0"

# Names that are imported on first access, by module.
LATER = {
    "lagjax.analysis.branches": "Branch Branches Critical",
    "lagjax.analysis.continuation": "continue_equilibria",
    "lagjax.analysis.continued_orbits": "continue_orbits",
    "lagjax.analysis.cycles": "OrbitWarning periodic_orbit",
    "lagjax.analysis.equilibria": "equilibria",
    "lagjax.analysis.floquet": "Floquet floquet",
    "lagjax.analysis.found": "Symmetries",
    "lagjax.analysis.found_equilibria": "Equilibria",
    "lagjax.analysis.hamilton": "Hamiltonian hamiltonian",
    "lagjax.analysis.least_action": "action",
    "lagjax.analysis.linearised": "Linearisation linearise",
    "lagjax.analysis.lyapunov": "LyapunovExponents lyapunov_exponents",
    "lagjax.analysis.modes": "Mode NormalModes normal_modes",
    "lagjax.analysis.orbit": "PeriodicOrbit",
    "lagjax.analysis.orbit_branch": "CriticalOrbit OrbitBranch",
    "lagjax.analysis.latex": "EquationsOfMotion latex",
    "lagjax.analysis.routh": "Routhian routhian",
    "lagjax.analysis.symmetries": "symmetries",
    "lagjax.analysis.symmetry": "SymmetryTest is_symmetry",
    "lagjax.exchange.from_sympy": "from_sympy",
    "lagjax.exchange.standalone_programs": "export result_codes",
    "lagjax.interactive.interact": "Knobs interact",
}


def __getattr__(name: str):
    """The worked systems and the names in `LATER`, imported on first access."""
    if name == "scenes":
        return import_module("lagjax.scenes")
    for module, names in LATER.items():
        if name in names.split():
            return getattr(import_module(module), name)
    raise AttributeError(f"module 'lagjax' has no attribute '{name}'.")


def __dir__():
    return sorted({*globals(), *__all__})


__all__ = [
    "System",
    "from_sympy",
    "Holonomic",
    "Nonholonomic",
    "Hybrid",
    "Switch",
    "touches",
    "releases",
    "slips",
    "sticks",
    "momentum",
    "mass_matrix",
    "accelerations",
    "jacobi_integral",
    "constraint_residual",
    "constraint_force",
    "consistent_state",
    "explain",
    "Explanation",
    "HybridExplanation",
    "integrate",
    "Crossing",
    "Crossings",
    "EventWarning",
    "JumpWarning",
    "poincare",
    "PoincareSection",
    "periods",
    "turning_points",
    "Dopri8",
    "Tsit5",
    "Nystrom8",
    "Nystrom12",
    "Radau5",
    "Replay",
    "Trajectory",
    "HybridTrajectory",
    "Switches",
    "Snapshot",
    "load_trajectory",
    "energy_ledger",
    "EnergyLedger",
    "Animation",
    "RESULTS",
    "AccuracyWarning",
    "PrecisionWarning",
    "Generator",
    "noether_charge",
    "NoetherCharge",
    "is_symmetry",
    "SymmetryTest",
    "symmetries",
    "Symmetries",
    "hamiltonian",
    "Hamiltonian",
    "routhian",
    "Routhian",
    "action",
    "latex",
    "EquationsOfMotion",
    "equilibria",
    "Equilibria",
    "continue_equilibria",
    "Branches",
    "Branch",
    "Critical",
    "linearise",
    "Linearisation",
    "normal_modes",
    "NormalModes",
    "Mode",
    "periodic_orbit",
    "PeriodicOrbit",
    "OrbitWarning",
    "continue_orbits",
    "OrbitBranch",
    "CriticalOrbit",
    "floquet",
    "Floquet",
    "lyapunov_exponents",
    "LyapunovExponents",
    "sweep",
    "Sweep",
    "Status",
    "open_sweep",
    "Page",
    "interact",
    "Knobs",
    "fit",
    "Record",
    "Fit",
    "FitWarning",
    "load_fit",
    "identifiability",
    "Identifiability",
    "learned",
    "WorkPrecision",
    "work_precision",
    "export",
    "result_codes",
    "scenes",
]
