"""lagjax"""
from lagjax.mechanics.constraints import Holonomic as Holonomic, Nonholonomic as Nonholonomic
from lagjax.mechanics.lagrangian import jacobi_integral as jacobi_integral, mass_matrix as mass_matrix, momentum as momentum
from lagjax.mechanics.multipliers import accelerations as accelerations, constraint_force as constraint_force, constraint_residual as constraint_residual
from lagjax.mechanics.system import System as System
from lagjax.motion.consistency import consistent_state as consistent_state
from lagjax.motion.integrate import integrate as integrate
from lagjax.motion.trajectory import RESULTS as RESULTS, Trajectory as Trajectory
