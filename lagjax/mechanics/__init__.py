"""The equations of motion at one state."""

from lagjax.mechanics.constrained_state import (
    accelerations,
    accelerations_at,
    consistent_state,
    constraint_force,
    constraint_residual,
    departures,
    free_coordinates,
    residuals_and_slopes,
    returned,
    to_manifold,
    unreachable_ahead,
    velocity_change,
    within,
    worst_residual,
)
from lagjax.mechanics.diagnosis import (
    IndefiniteMass,
    dependencies,
    describe,
    explain_failure,
    indefinite_in_words,
    indefinite_mass,
    listed,
    where,
)
from lagjax.mechanics.equations import Equations, all_finite, equations_of, has_networks
from lagjax.mechanics.inverse_dynamics import inverse_dynamics
from lagjax.mechanics.lagrangian import (
    applied_force,
    completed,
    forcing_and_inertia,
    jacobi_integral,
    mass_and_forcing,
    mass_matrix,
    momentum,
    of_states,
    resolved,
    response,
    with_first_order,
)
from lagjax.mechanics.noether import (
    AXES,
    Generator,
    GeneratorFlow,
    NoetherCharge,
    as_generator,
    flow,
    noether_charge,
    points,
    turned,
)
from lagjax.mechanics.saddle_point import SINGULAR_BELOW, examined, solve_saddle_point
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
