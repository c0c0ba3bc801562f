"""Methods and linear algebra that know no mechanics."""

from lagjax.numerics import banded, dense, lapack, quadrature
from lagjax.numerics.dense import (
    DEPENDENT_BELOW,
    SINGULAR_BELOW,
    independent_rows,
    null_space,
    reciprocal_condition,
    solve_without_exchanges,
    unit_rows,
)
from lagjax.numerics.lapack import Roots, general_roots, roots_beside_zeros, symmetric_roots, zero_count
from lagjax.numerics.newton import (
    MOST,
    ByWindows,
    Covariance,
    Slopes,
    Unknowns,
    WindowedEquations,
    covariance,
    damped_newton,
    differentiable,
    eliminate,
    filled,
    largest,
    last_step,
    least_squares_root,
    newton,
    newton_in_python,
    slopes_of,
    while_in_python,
    with_value,
    zero_below,
)
from lagjax.numerics.radau import Radau5, SimplifiedNewton, tolerance_of_the_controller, with_tolerances
from lagjax.numerics.runge_kutta import (
    RK4,
    Dopri8,
    ExplicitRungeKutta,
    Interpolation,
    Nystrom,
    Nystrom8,
    Nystrom12,
    Quintic,
    Tsit5,
    evaluations_a_step,
    in_our_form,
)
from lagjax.numerics.symplectic import EqualSteps, Gauss, Splitting, Tableau, lengths, sequence, tableau
