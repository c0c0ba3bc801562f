"""Methods and linear algebra that know no mechanics."""

from lagjax.numerics import quadrature
from lagjax.numerics.linalg import banded, dense, lapack
from lagjax.numerics.linalg.dense import SINGULAR_BELOW, reciprocal_condition, solve_without_exchanges
from lagjax.numerics.linalg.eigenvalues import Roots, general_roots, roots_beside_zeros, symmetric_roots, zero_count
from lagjax.numerics.linalg.rank import DEPENDENT_BELOW, independent_rows, null_space, unit_rows
from lagjax.numerics.methods.gauss import EqualSteps, Gauss, Tableau, tableau
from lagjax.numerics.methods.nystrom import Nystrom, Nystrom8, Nystrom12, Quintic, evaluations_a_step
from lagjax.numerics.methods.radau import Radau5, SimplifiedNewton, tolerance_of_the_controller, with_tolerances
from lagjax.numerics.methods.runge_kutta import RK4, Dopri8, ExplicitRungeKutta, Interpolation, Tsit5, in_our_form
from lagjax.numerics.methods.splitting import Splitting, lengths, sequence
from lagjax.numerics.newton import (
    MOST,
    damped_newton,
    differentiable,
    largest,
    last_step,
    least_squares_root,
    newton,
    newton_in_python,
    while_in_python,
    with_value,
    zero_below,
)
from lagjax.numerics.windowed_least_squares import (
    ByWindows,
    Covariance,
    Slopes,
    Unknowns,
    WindowedEquations,
    covariance,
    eliminate,
    filled,
    slopes_of,
)
