"""The map: public names in the order of the physics, each with the room that hands it out; read at run time too."""

__version__: str
__all__: list[str]

# isort: split
# A system: its Lagrangian and its constraints.
from . import guards as guards
from .mechanics import (
    Generator as Generator,
)
from .mechanics import (
    noether_charge as noether_charge,
)
from .system import (
    CompliantContact as CompliantContact,
)
from .system import (
    Contact as Contact,
)
from .system import (
    Elements as Elements,
)
from .system import (
    Friction as Friction,
)
from .system import (
    Holonomic as Holonomic,
)
from .system import (
    Hybrid as Hybrid,
)
from .system import (
    Nonholonomic as Nonholonomic,
)
from .system import (
    SampledControl as SampledControl,
)
from .system import (
    Stop as Stop,
)
from .system import (
    Switch as Switch,
)
from .system import (
    System as System,
)

# isort: split
# Rigid bodies, joints and loads; what they look like.
from . import bodies as bodies
from . import shapes as shapes

# isort: split
# Mechanisms from files.
from .models import read_mjcf as read_mjcf
from .models import read_urdf as read_urdf

# isort: split
# One state: quantities from the Lagrangian and the constraints.
from .analysis.explain import explain as explain
from .integrate import draw as draw
from .mechanics import (
    accelerations as accelerations,
)
from .mechanics import (
    consistent_state as consistent_state,
)
from .mechanics import (
    constraint_force as constraint_force,
)
from .mechanics import (
    constraint_residual as constraint_residual,
)
from .mechanics import (
    inverse_dynamics as inverse_dynamics,
)
from .mechanics import (
    jacobi_integral as jacobi_integral,
)
from .mechanics import (
    mass_matrix as mass_matrix,
)
from .mechanics import (
    momentum as momentum,
)

# isort: split
# Motion.
from .analysis.energy import energy_ledger as energy_ledger
from .analysis.poincare import (
    PoincareSection as PoincareSection,
)
from .analysis.poincare import (
    periods as periods,
)
from .analysis.poincare import (
    poincare as poincare,
)
from .analysis.poincare import (
    turning_points as turning_points,
)
from .integrate import (
    RESULTS as RESULTS,
)
from .integrate import (
    AccuracyWarning as AccuracyWarning,
)
from .integrate import (
    Crossing as Crossing,
)
from .integrate import (
    EventWarning as EventWarning,
)
from .integrate import (
    JumpWarning as JumpWarning,
)
from .integrate import (
    Replay as Replay,
)
from .integrate import (
    integrate as integrate,
)
from .integrate import (
    load_trajectory as load_trajectory,
)
from .numerics import (
    RK4 as RK4,
)
from .numerics import (
    Dopri8 as Dopri8,
)
from .numerics import (
    Gauss as Gauss,
)
from .numerics import (
    Nystrom8 as Nystrom8,
)
from .numerics import (
    Nystrom12 as Nystrom12,
)
from .numerics import (
    Radau5 as Radau5,
)
from .numerics import (
    Splitting as Splitting,
)
from .numerics import (
    Tsit5 as Tsit5,
)
from .steps import rollout as rollout
from .steps import step as step
from .system import PrecisionWarning as PrecisionWarning

# isort: split
# Analysis of a system.
from .analysis.branches import continue_equilibria as continue_equilibria
from .analysis.cycles import continue_orbits as continue_orbits
from .analysis.equilibria import equilibria as equilibria
from .analysis.exponents import floquet as floquet
from .analysis.exponents import lyapunov_exponents as lyapunov_exponents
from .analysis.formulations import action as action
from .analysis.formulations import hamiltonian as hamiltonian
from .analysis.formulations import routhian as routhian
from .analysis.latex import latex as latex
from .analysis.linearise import linearise as linearise
from .analysis.normal_modes import normal_modes as normal_modes
from .analysis.periodic_orbit import OrbitWarning as OrbitWarning
from .analysis.periodic_orbit import periodic_orbit as periodic_orbit
from .analysis.symmetry_search import symmetries as symmetries
from .analysis.symmetry_test import is_symmetry as is_symmetry

# isort: split
# Two points.
from .two_points import (
    ConnectWarning as ConnectWarning,
)
from .two_points import (
    connect as connect,
)
from .two_points import (
    exponential_map as exponential_map,
)
from .two_points import (
    geodesic as geodesic,
)
from .two_points import (
    lqr as lqr,
)
from .two_points import (
    parallel_transport as parallel_transport,
)
from .two_points import (
    steer as steer,
)

# isort: split
# Many motions.
from .sweep import open_sweep as open_sweep
from .sweep import sweep as sweep

# isort: split
# Many motions, in a notebook.
from .sliders import interact as interact

# isort: split
# From measured motion.
from . import learned as learned
from .fit import (
    FitWarning as FitWarning,
)
from .fit import (
    Record as Record,
)
from .fit import (
    fit as fit,
)
from .fit import (
    fit_loss as fit_loss,
)
from .fit import (
    fit_residuals as fit_residuals,
)
from .fit import (
    identifiability as identifiability,
)
from .fit import (
    load_fit as load_fit,
)

# isort: split
# Error against run time.
from . import scenes as scenes
from .work_precision import (
    horizons as horizons,
)
from .work_precision import (
    work_precision as work_precision,
)

# isort: split
# Import and export.
from .exchange import export as export
from .exchange import from_sympy as from_sympy
from .exchange import result_codes as result_codes

# isort: split
# Compiled programs, kept from one process to the next.
from .files import cache as cache

# Names that have left this map, by where they are.
MOVED: dict[str, str]
