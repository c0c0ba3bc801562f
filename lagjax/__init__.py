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
from lagjax.mechanics.generators import Generator
from lagjax.mechanics.noether import NoetherCharge, noether_charge
from lagjax.system.constraints import Holonomic, Nonholonomic
from lagjax.system.hybrid import Hybrid, Switch
from lagjax.system.system import System

# isort: split
# One state: quantities from the Lagrangian and the constraints.
from lagjax.analysis.explain import Explanation, explain
from lagjax.mechanics.accelerations import accelerations, constraint_force, constraint_residual
from lagjax.mechanics.consistent_state import consistent_state
from lagjax.mechanics.lagrangian import jacobi_integral, mass_matrix, momentum

# isort: split
# Motion.
from lagjax.analysis.energy import EnergyLedger, energy_ledger
from lagjax.analysis.explain import HybridExplanation
from lagjax.analysis.poincare import PoincareSection, periods, poincare, turning_points
from lagjax.display.animation import Animation
from lagjax.integrate.adjoint.replay import Replay
from lagjax.integrate.contacts.contacts import releases, slips, sticks, touches
from lagjax.integrate.events.event import Crossing, Crossings, EventWarning
from lagjax.integrate.integrate import integrate
from lagjax.integrate.load import load_trajectory
from lagjax.integrate.solve.over_jumps import JumpWarning
from lagjax.integrate.trajectory.hybrid_trajectory import HybridTrajectory, Switches
from lagjax.integrate.trajectory.results import RESULTS
from lagjax.integrate.trajectory.trajectory import AccuracyWarning, Snapshot, Trajectory
from lagjax.numerics.methods.nystrom import Nystrom8, Nystrom12
from lagjax.numerics.methods.radau import Radau5
from lagjax.numerics.methods.runge_kutta import Dopri8, Tsit5
from lagjax.system.coordinates import PrecisionWarning

# isort: split
# Many motions.
from lagjax.display.web_page.page import Page
from lagjax.sweep.batch_program import Status
from lagjax.sweep.result import Sweep, open_sweep
from lagjax.sweep.sweep import sweep

# isort: split
# From measured motion.
from lagjax import learned
from lagjax.fit.fit import fit
from lagjax.fit.identifiability import identifiability
from lagjax.fit.load import load_fit
from lagjax.fit.loss import FitFunction, fit_loss, fit_residuals
from lagjax.fit.problem.arguments import FitWarning
from lagjax.fit.problem.records import Record
from lagjax.fit.result.result import Fit
from lagjax.fit.uncertainty.identifiable import Identifiability

# isort: split
# Error against run time.
from lagjax.work_precision.result import WorkPrecision
from lagjax.work_precision.work_precision import work_precision

if TYPE_CHECKING:
    from lagjax import scenes
    from lagjax.analysis.continuation.equilibria import continue_equilibria
    from lagjax.analysis.continuation.orbit_result import CriticalOrbit, OrbitBranch
    from lagjax.analysis.continuation.orbits import continue_orbits

    # Analysis of a system.
    from lagjax.analysis.continuation.result import Branch, Branches, Critical
    from lagjax.analysis.equilibria.equilibria import equilibria
    from lagjax.analysis.equilibria.result import Equilibria
    from lagjax.analysis.formulations.action import action
    from lagjax.analysis.formulations.hamiltonian import Hamiltonian, hamiltonian
    from lagjax.analysis.formulations.latex import EquationsOfMotion, latex
    from lagjax.analysis.formulations.routhian import Routhian, routhian
    from lagjax.analysis.modes.linearise import Linearisation, linearise
    from lagjax.analysis.modes.normal_modes import Mode, NormalModes, normal_modes
    from lagjax.analysis.orbits.floquet import Floquet, floquet
    from lagjax.analysis.orbits.lyapunov import LyapunovExponents, lyapunov_exponents
    from lagjax.analysis.orbits.periodic_orbit import OrbitWarning, periodic_orbit
    from lagjax.analysis.orbits.result import PeriodicOrbit
    from lagjax.analysis.symmetry.is_symmetry import SymmetryTest, is_symmetry
    from lagjax.analysis.symmetry.result import Symmetries
    from lagjax.analysis.symmetry.search import symmetries

    # Import and export.
    from lagjax.exchange.from_sympy import from_sympy
    from lagjax.exchange.standalone_programs import export, result_codes

    # Many motions, in a notebook.
    from lagjax.sliders.interact import Knobs, interact


__version__ = "0.2.0"

# Names that are imported on first access, by module.
LATER = {
    "lagjax.analysis.continuation.result": "Branch Branches Critical",
    "lagjax.analysis.continuation.equilibria": "continue_equilibria",
    "lagjax.analysis.continuation.orbits": "continue_orbits",
    "lagjax.analysis.orbits.periodic_orbit": "OrbitWarning periodic_orbit",
    "lagjax.analysis.equilibria.equilibria": "equilibria",
    "lagjax.analysis.orbits.floquet": "Floquet floquet",
    "lagjax.analysis.symmetry.result": "Symmetries",
    "lagjax.analysis.equilibria.result": "Equilibria",
    "lagjax.analysis.formulations.hamiltonian": "Hamiltonian hamiltonian",
    "lagjax.analysis.formulations.action": "action",
    "lagjax.analysis.modes.linearise": "Linearisation linearise",
    "lagjax.analysis.orbits.lyapunov": "LyapunovExponents lyapunov_exponents",
    "lagjax.analysis.modes.normal_modes": "Mode NormalModes normal_modes",
    "lagjax.analysis.orbits.result": "PeriodicOrbit",
    "lagjax.analysis.continuation.orbit_result": "CriticalOrbit OrbitBranch",
    "lagjax.analysis.formulations.latex": "EquationsOfMotion latex",
    "lagjax.analysis.formulations.routhian": "Routhian routhian",
    "lagjax.analysis.symmetry.search": "symmetries",
    "lagjax.analysis.symmetry.is_symmetry": "SymmetryTest is_symmetry",
    "lagjax.exchange.from_sympy": "from_sympy",
    "lagjax.exchange.standalone_programs": "export result_codes",
    "lagjax.sliders.interact": "Knobs interact",
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
    "fit_residuals",
    "fit_loss",
    "FitFunction",
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
