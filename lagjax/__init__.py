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
from lagjax.mechanics import Generator, NoetherCharge, noether_charge
from lagjax.system import (
    CompliantContact,
    Contact,
    Elements,
    Friction,
    Holonomic,
    Hybrid,
    Nonholonomic,
    SampledControl,
    Stop,
    Switch,
    System,
)

# isort: split
# One state: quantities from the Lagrangian and the constraints.
from lagjax.analysis import Explanation, explain
from lagjax.display import Still
from lagjax.integrate import draw
from lagjax.mechanics import (
    accelerations,
    consistent_state,
    constraint_force,
    constraint_residual,
    jacobi_integral,
    mass_matrix,
    momentum,
)

# isort: split
# Motion.
from lagjax.analysis import (
    EnergyLedger,
    HybridExplanation,
    PoincareSection,
    energy_ledger,
    periods,
    poincare,
    turning_points,
)
from lagjax.display import Animation, Drawing, Shape
from lagjax.integrate import (
    RESULTS,
    AccuracyWarning,
    Crossing,
    Crossings,
    EventWarning,
    HybridTrajectory,
    JumpWarning,
    Replay,
    Snapshot,
    Switches,
    Trajectory,
    integrate,
    load_trajectory,
    releases,
    slips,
    sticks,
    touches,
)
from lagjax.numerics import RK4, Dopri8, Gauss, Nystrom8, Nystrom12, Radau5, Splitting, Tsit5
from lagjax.steps import rollout, step
from lagjax.system import PrecisionWarning

# isort: split
# Many motions.
from lagjax.display import Page
from lagjax.sweep import Status, Sweep, open_sweep, sweep

# isort: split
# From measured motion.
from lagjax import learned
from lagjax.fit import (
    Fit,
    FitFunction,
    FitWarning,
    Identifiability,
    Record,
    fit,
    fit_loss,
    fit_residuals,
    identifiability,
    load_fit,
)

# isort: split
# Error against run time.
from lagjax.work_precision import Horizons, WorkPrecision, horizons, work_precision

if TYPE_CHECKING:
    from lagjax import scenes

    # Analysis of a system.
    from lagjax.analysis import (
        Branch,
        Branches,
        Critical,
        CriticalOrbit,
        EquationsOfMotion,
        Equilibria,
        Floquet,
        Hamiltonian,
        Linearisation,
        LyapunovExponents,
        Mode,
        NormalModes,
        OrbitBranch,
        OrbitWarning,
        PeriodicOrbit,
        Routhian,
        Symmetries,
        SymmetryTest,
        continue_equilibria,
        continue_orbits,
        lyapunov_exponents,
        symmetries,
    )
    from lagjax.analysis.equilibria import equilibria
    from lagjax.analysis.formulations import action, hamiltonian, latex, routhian
    from lagjax.analysis.modes import linearise, normal_modes
    from lagjax.analysis.orbits import floquet, periodic_orbit
    from lagjax.analysis.symmetry import is_symmetry

    # Rigid bodies.
    from lagjax.bodies import (
        Body,
        Load,
        Marker,
        Pose,
        Surface,
        Tree,
        applied,
        box,
        cylinder,
        cylindrical,
        disk,
        fixed,
        gear,
        ground,
        line,
        mesh,
        motor,
        multibody,
        planar,
        prismatic,
        rack_and_pinion,
        revolute,
        rod,
        rolling,
        rolling_ellipsoid,
        rolling_sphere,
        sphere,
        spherical,
        spring,
        torsion,
        trail,
        universal,
        weight,
    )

    # Import and export.
    from lagjax.exchange import export, from_sympy, result_codes

    # Mechanisms from files.
    from lagjax.models import RobotModel, read_mjcf, read_urdf

    # Many motions, in a notebook.
    from lagjax.sliders import Knobs, interact

    # Two points.
    from lagjax.two_points import (
        LQR,
        Connection,
        ConnectWarning,
        Geodesic,
        Steering,
        TrackingLQR,
        connect,
        exponential_map,
        geodesic,
        lqr,
        parallel_transport,
        steer,
    )


__version__ = "0.2.0"

# Names that are imported on first access, by the room that hands them out.
LATER = {
    "lagjax.analysis.continuation": (
        "Branch Branches Critical CriticalOrbit OrbitBranch continue_equilibria continue_orbits"
    ),
    "lagjax.analysis.equilibria": "Equilibria equilibria",
    "lagjax.analysis.formulations": "EquationsOfMotion Hamiltonian Routhian action hamiltonian latex routhian",
    "lagjax.analysis.modes": "Linearisation Mode NormalModes linearise normal_modes",
    "lagjax.analysis.orbits": (
        "Floquet LyapunovExponents OrbitWarning PeriodicOrbit floquet lyapunov_exponents periodic_orbit"
    ),
    "lagjax.analysis.symmetry": "Symmetries SymmetryTest is_symmetry symmetries",
    "lagjax.bodies": (
        "Body Load Marker Pose Surface Tree applied box cylinder cylindrical disk fixed gear ground line mesh "
        "motor multibody planar prismatic rack_and_pinion revolute rod rolling rolling_ellipsoid rolling_sphere sphere "
        "spherical spring torsion trail universal weight"
    ),
    "lagjax.exchange": "export from_sympy result_codes",
    "lagjax.models": "RobotModel read_mjcf read_urdf",
    "lagjax.sliders": "Knobs interact",
    "lagjax.two_points": (
        "Connection ConnectWarning Geodesic LQR Steering TrackingLQR connect exponential_map geodesic lqr "
        "parallel_transport steer"
    ),
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
    "Contact",
    "CompliantContact",
    "Friction",
    "Stop",
    "SampledControl",
    "Elements",
    "Body",
    "Pose",
    "Surface",
    "ground",
    "Marker",
    "Tree",
    "multibody",
    "spherical",
    "revolute",
    "universal",
    "cylindrical",
    "planar",
    "prismatic",
    "fixed",
    "rolling",
    "rolling_ellipsoid",
    "rolling_sphere",
    "gear",
    "rack_and_pinion",
    "Load",
    "weight",
    "spring",
    "torsion",
    "motor",
    "applied",
    "box",
    "cylinder",
    "sphere",
    "disk",
    "mesh",
    "rod",
    "line",
    "trail",
    "read_urdf",
    "read_mjcf",
    "RobotModel",
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
    "draw",
    "Still",
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
    "step",
    "rollout",
    "Dopri8",
    "Tsit5",
    "RK4",
    "Nystrom8",
    "Gauss",
    "Nystrom12",
    "Radau5",
    "Splitting",
    "Replay",
    "Trajectory",
    "HybridTrajectory",
    "Switches",
    "Snapshot",
    "load_trajectory",
    "energy_ledger",
    "EnergyLedger",
    "Animation",
    "Drawing",
    "Shape",
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
    "connect",
    "Connection",
    "ConnectWarning",
    "geodesic",
    "Geodesic",
    "exponential_map",
    "parallel_transport",
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
    "steer",
    "Steering",
    "lqr",
    "LQR",
    "TrackingLQR",
    "WorkPrecision",
    "work_precision",
    "horizons",
    "Horizons",
    "export",
    "result_codes",
    "scenes",
]
