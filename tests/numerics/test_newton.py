"""Newton's method in its three ways: roots of SciPy, their derivatives in closed form, and where it gives up."""

import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize

from lagjax.numerics.newton import differentiable, last_step, least_squares_root, newton, newton_in_python


def circle_and_line(a):
    """x² + y² = a and y = 2 x: the roots are ±√(a/5) (1, 2)."""
    return lambda y: jnp.stack([y[0] ** 2 + y[1] ** 2 - a, y[1] - 2.0 * y[0]])


def test_steps_are_shortened():
    """arctan from 3 converges with shortened steps; twin: whole steps leave it."""
    step = lambda y, r, i: r * (1 + y**2)
    run = lambda **settings: newton(jnp.arctan, step, jnp.array([3.0]), 12, **settings)
    np.testing.assert_allclose(run(fractions=0.5 ** np.arange(6)), 0.0, atol=1e-15)
    assert not np.abs(run()[0]) < 1.0


def test_it_ends_where_it_is_told():
    """A residual that falls too slowly ends the iteration early."""
    counted = lambda **settings: newton(lambda y: y**2, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 40, **settings)
    # At this double root each step halves y.
    np.testing.assert_allclose(counted(), 0.5**40, rtol=1e-12)
    np.testing.assert_allclose(counted(falls=0.2), 0.5, rtol=1e-12)
    np.testing.assert_allclose(counted(enough=1e-3), 0.5**5, rtol=1e-12)


def test_the_slowest_level_decides():
    """Of two levels the second falls by 9/16 in each step, to a thousandth in 13; twin: the first alone takes 5."""
    slow = np.array([[2.0], [4.0]])
    run = lambda level, size: newton(
        lambda y: y**2, lambda y, r, i: r / (slow * y), jnp.ones((2, 1)), 40, size=size, enough=1e-3
    )[level, 0]
    np.testing.assert_allclose(run(1, lambda r: r[:, 0]), 0.75**13, rtol=1e-12)
    np.testing.assert_allclose(run(0, lambda r: r[:1, 0].repeat(2)), 0.5**5, rtol=1e-12)


def test_one_more_step_has_the_derivatives():
    """d√a/da = 1/(2 √a) in both modes, from a root found without derivatives."""

    def root(a):
        near = jax.lax.stop_gradient(newton(lambda y: y**2 - a, lambda y, r, i: r / (2 * y), jnp.array([1.0]), 8))
        return last_step(near, jnp.array([1.0]), lambda y: (y**2 - a) / jax.lax.stop_gradient(2 * y))[0]

    both = jax.jit(lambda a: (jax.grad(root)(a), jax.jacfwd(root)(a)))
    np.testing.assert_allclose(both(5.0), 0.5 / np.sqrt(5.0), rtol=1e-14)


def test_least_squares_against_scipy():
    """A root from far away, and its derivatives of two orders; twin: without `differentiable` these are zero."""
    start = jnp.array([4.0, -1.0])

    def x(a, with_derivatives=True):
        found = least_squares_root(circle_and_line(jax.lax.stop_gradient(a)), start)
        y = differentiable(circle_and_line(a), found) if with_derivatives else found.y
        return y[0], y

    of_a = jax.jit(lambda a: (x(a)[1], jax.grad(x, has_aux=True)(a)[0], jax.jacfwd(jax.grad(lambda a: x(a)[0]))(a)))
    y, slope, bend = of_a(5.0)
    np.testing.assert_allclose(y, scipy.optimize.root(circle_and_line(5.0), start, tol=1e-14).x, rtol=1e-12)
    np.testing.assert_allclose([slope, bend], [0.1, -0.01], rtol=1e-12)
    assert jax.jit(jax.jacfwd(lambda a: x(a, with_derivatives=False)[0]))(5.0) == 0.0


def test_in_python():
    """√2 to round-off with lengths that fall; None where steps do not shrink, or where there is none to take."""
    found = newton_in_python(lambda y: (y**2 - 2.0) / (2 * y), np.array([1.0]), 20, free=1)
    assert found is not None and found.converged and found.lengths[2] < found.lengths[1] < found.lengths[0]
    np.testing.assert_allclose(found.y, np.sqrt(2.0), rtol=1e-15)
    assert newton_in_python(lambda y: -(2.0**y), np.array([1.0]), 20, free=1, noise=1e-3) is None
    assert newton_in_python(lambda y: None, np.array([1.0]), 20) is None
    unfinished = newton_in_python(lambda y: (y**2 - 2.0) / (2 * y), np.array([1.0]), 2, enough=1e-12)
    assert unfinished is not None and not unfinished.converged
