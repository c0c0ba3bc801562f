"""lagjax: a differentiable Lagrangian integrator.

Write a Lagrangian as a plain JAX function `L(t, q, v, params)`; everything else follows from it. `__init__.pyi` lists
the names in the order of the physics; each is imported on first access. Bodies, joints and loads are in `lj.bodies`,
shapes for pictures in `lj.shapes`, guards of contacts in `lj.guards`, worked systems in `lj.scenes`. Results are what
functions return; their classes are imported from where they are defined, `from lagjax.integrate import Trajectory`.

    M a = F + Aᵀ λ      M = ∂²L/∂v∂v,   F = ∂L/∂q - ∂p/∂t - (∂p/∂q) v + Q - ∂R/∂v,   p = ∂L/∂v
    A a = gamma         A = ∂g/∂q (holonomic g = 0) or ∂phi/∂v (velocity constraint phi = 0)

λ > 0 pushes along +∂g/∂q; `R = ½ c v²` gives the force `-c v`; `jacobi_integral` is `v·p - L`, which is
T + V only for natural, time-independent coordinates.
"""

import sys

import lazy_loader

if "jax" in sys.modules:
    # Not later: JAX would compile again what it has compiled by then.
    from lagjax import contexts as contexts

__version__ = "0.2.0"

# Names that were in `lj.` once, by where they are now; `docs/CHANGELOG.md` has the same under *Renamed*.
MOVED = {
    "lj.bodies": "Body Load Marker Pose Surface Tree applied cylindrical fixed gear ground motor multibody planar "
    "prismatic rack_and_pinion revolute rolling rolling_ellipsoid rolling_sphere spherical spring torsion universal "
    "weight",
    "lj.guards": "releases slips sticks touches",
    "lj.shapes": "Drawing Shape box cylinder disk line mesh rod sphere trail",
    "lagjax.analysis.balance": "Equilibria",
    "lagjax.analysis.branches": "Branch Branches Critical",
    "lagjax.analysis.cycles": "CriticalOrbit OrbitBranch",
    "lagjax.analysis.energy": "EnergyLedger",
    "lagjax.analysis.explain": "Explanation HybridExplanation",
    "lagjax.analysis.exponents": "Floquet LyapunovExponents",
    "lagjax.analysis.formulations": "Hamiltonian Routhian",
    "lagjax.analysis.latex": "EquationsOfMotion",
    "lagjax.analysis.linearise": "Linearisation",
    "lagjax.analysis.normal_modes": "Mode NormalModes",
    "lagjax.analysis.periodic_orbit": "PeriodicOrbit",
    "lagjax.analysis.symmetry_result": "Symmetries",
    "lagjax.analysis.symmetry_test": "SymmetryTest",
    "lagjax.display": "Animation Page Still",
    "lagjax.fit": "Fit FitFunction Identifiability",
    "lagjax.integrate": "Crossings HybridTrajectory Snapshot Switches Trajectory",
    "lagjax.mechanics": "NoetherCharge",
    "lagjax.models": "RobotModel",
    "lagjax.sliders": "Knobs",
    "lagjax.sweep": "Status Sweep",
    "lagjax.two_points": "Connection Geodesic LQR Steering TrackingLQR",
    "lagjax.work_precision": "Horizons WorkPrecision",
}

# Scientific Python's SPEC 1. `EAGER_IMPORT=1` in the environment imports all at once.
_imported, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name):
    """Import a name of the map, or say where one is that has left it."""
    for place, names in MOVED.items():
        if name in names.split():
            now = f"{place}.{name}" if place.startswith("lj.") else f"from {place} import {name}"
            what = f"is in {place}" if place.startswith("lj.") else "is a result, which functions return"
            raise AttributeError(f"lj.{name} has moved: it {what}.\nFix: {now}")
    return _imported(name)
