"""The equations of motion at one state."""

from lagjax.mechanics.accelerations import accelerations, accelerations_at, constraint_force, constraint_residual
from lagjax.mechanics.consistent_state import consistent_state, free_coordinates, unreachable_ahead
from lagjax.mechanics.diagnosis import dependencies, describe, explain_failure, listed, where
from lagjax.mechanics.equations import Equations, all_finite, equations_of
from lagjax.mechanics.first_order import completed, of_states, resolved, with_first_order
from lagjax.mechanics.generators import AXES, Generator, as_generator, points, turned
from lagjax.mechanics.indefinite_mass import IndefiniteMass, indefinite_mass
from lagjax.mechanics.lagrangian import (
    applied_force,
    forcing_and_inertia,
    jacobi_integral,
    mass_and_forcing,
    mass_matrix,
    momentum,
)
from lagjax.mechanics.multiplier_forces import response
from lagjax.mechanics.noether import GeneratorFlow, NoetherCharge, flow, noether_charge
from lagjax.mechanics.projection import departures, returned, to_manifold, velocity_change, within, worst_residual
from lagjax.mechanics.saddle_point import SINGULAR_BELOW, examined, solve_saddle_point
from lagjax.mechanics.scalar_equations import has_networks
from lagjax.mechanics.structure import (
    Structure,
    are_angles,
    conserved_momenta,
    conserves_jacobi_integral,
    forced_by,
    invariance,
    is_autonomous,
    is_free_of_velocities,
    sees_time,
    sees_velocities,
    structure,
    what_changes_jacobi_integral,
    what_changes_momentum,
)
