"""Newton's method in its three ways: roots of SciPy, their derivatives in closed form, and where it gives up."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from lagjax.numerics.newton import differentiable, last_step, least_squares_root, newton, newton_in_python


def circle_and_line(a):
    """x² + y² = a and y = 2 x: the roots are ±√(a/5) (1, 2)."""
    return lambda y: jnp.stack([y[0] ** 2 + y[1] ** 2 - a, y[1] - 2.0 * y[0]])


def test_loops():
    """Steps are shortened (arctan from 3; twin: whole steps leave it), and end where the residual falls enough.

    At a double root each step halves y. Of two levels the slowest decides: its second falls by 9/16 in each step, to a
    thousandth in 13; twin: the first alone takes 5.
    """
    atan = partial(newton, jnp.arctan, lambda y, r, i: r * (1 + y**2), jnp.array([3.0]), 12)
    double = partial(newton, lambda y: y**2, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 40)
    slow = np.array([[2.0], [4.0]])
    levels = partial(newton, lambda y: y**2, lambda y, r, i: r / (slow * y), jnp.ones((2, 1)), 40, enough=1e-3)
    found = jax.jit(lambda: [
        atan(fractions=0.5 ** np.arange(6)), atan(), double(), double(falls=0.2), double(enough=1e-3),
        levels(size=lambda r: r[:, 0])[1], levels(size=lambda r: r[:1, 0].repeat(2))[0],
    ])()  # fmt: skip
    shortened, left, *others = (float(x[0]) for x in found)
    assert abs(shortened) < 1e-15 and not abs(left) < 1.0
    np.testing.assert_allclose(others, [0.5**40, 0.5, 0.5**5, 0.75**13, 0.5**5], rtol=1e-12)


def test_one_more_step_has_the_derivatives():
    """d√a/da = 1/(2 √a) in both modes, from a root found without derivatives."""

    def root(a):
        near = jax.lax.stop_gradient(newton(lambda y: y**2 - a, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 8))
        return last_step(near, jnp.array([1.0]), lambda y: (y**2 - a) / jax.lax.stop_gradient(2 * y))[0]

    both = jax.jit(lambda a: (jax.grad(root)(a), jax.jacfwd(root)(a)))
    np.testing.assert_allclose(both(5.0), 0.5 / np.sqrt(5.0), rtol=1e-14)


def test_least_squares_against_scipy():
    """A root from far away, and its derivatives of two orders; twin: without `differentiable` these are zero."""
    start = np.array([4.0, -1.0])

    def x(a, with_derivatives=True):
        found = least_squares_root(circle_and_line(jax.lax.stop_gradient(a)), start)
        return (differentiable(circle_and_line(a), found) if with_derivatives else found.y)[0]

    @jax.jit
    def of_a(a):
        near = least_squares_root(circle_and_line(a), start).y
        slope, bend = jax.jvp(jax.grad(x), (a,), (1.0,))
        return near, slope, bend, jax.jvp(lambda a: x(a, with_derivatives=False), (a,), (1.0,))[1]

    y, slope, bend, without = of_a(5.0)
    exact = scipy.optimize.root(lambda y: [y[0] ** 2 + y[1] ** 2 - 5.0, y[1] - 2.0 * y[0]], start, tol=1e-14).x
    np.testing.assert_allclose(y, exact, rtol=1e-12)
    np.testing.assert_allclose([slope, bend], [0.1, -0.01], rtol=1e-12)
    assert without == 0.0


def test_in_python():
    """√2 to round-off with lengths that fall; None where steps do not shrink, or where there is none to take."""
    found = newton_in_python(lambda y: (y**2 - 2.0) / (2 * y), np.array([1.0]), 20, free=1)
    assert found is not None and found.converged and found.lengths[2] < found.lengths[1] < found.lengths[0]
    np.testing.assert_allclose(found.y, np.sqrt(2.0), rtol=1e-15)
    assert newton_in_python(lambda y: -(2.0**y), np.array([1.0]), 20, free=1, noise=1e-3) is None
    assert newton_in_python(lambda y: None, np.array([1.0]), 20) is None
    unfinished = newton_in_python(lambda y: (y**2 - 2.0) / (2 * y), np.array([1.0]), 2, enough=1e-12)
    assert unfinished is not None and not unfinished.converged
