"""A mass matrix with an eigenvalue below zero is named, with its numbers; what only touches zero is not."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.mechanics import indefinite_in_words, indefinite_mass
from lagjax.system import coordinates, model_of


def said(lagrangian, start, end, constraints=None):
    """What is said of a motion from `start` to `end`, each (t, q, v)."""
    first, last = (coordinates.state(*s, None) for s in (start, end))
    return indefinite_mass(model_of(lj.System(lagrangian, constraints or {}), *first), first, last)


def falling(t, q, v, params):
    """A mass that is q: no motion passes q = 0."""
    return 0.5 * q * v**2


def test_an_eigenvalue_that_passes_zero_is_named():
    """From q = 1 to 1e-6 and on downward, and back up from -1; twins: upward it stays above zero, downward far off."""
    found = said(falling, (0.0, 1.0, -1.0), (0.6, 1e-6, -1e3))
    assert found.crossed and "is 1 at the start, 1e-06 at the end and -" in found.cause
    assert said(falling, (0.0, -1.0, 1.0), (0.6, -1e-6, 1e3)).crossed
    assert said(falling, (0.0, 1.0, 1.0), (0.6, 2.0, 0.7)) is None
    assert said(falling, (0.0, 1.0, -1.0), (0.1, 0.9, -1.1)) is None


def test_it_was_jumped_over():
    """The end has another sign than the start."""
    found = said(falling, (0.0, 1.0, -1.0), (0.6, -0.5, -1.0))
    assert found.crossed and "-0.5 at the end" in found.cause


def test_backward_in_time_beyond_is_earlier():
    """A motion computed backward comes to q = 0 with a velocity upward; twin: forward it leaves."""
    assert said(falling, (1.0, 1.0, 1.0), (0.4, 1e-6, 1e3)).crossed
    assert said(falling, (0.0, 1.0, 1.0), (0.6, 1e-6, 1e3)) is None


def test_a_coordinate_singularity_is_not_blamed():
    """r² of polar coordinates touches zero at the pole, and is above zero beyond."""
    polar = lambda t, q, v, params: 0.5 * (v[0] ** 2 + (q[0] * v[1]) ** 2) + 1 / q[0]
    start, end = (0.0, jnp.array([1.0, 0.0]), jnp.zeros(2)), (1.1, jnp.array([1e-6, 0.0]), jnp.array([-1e3, 0.0]))
    assert said(polar, start, end) is None


def test_negative_from_the_start_is_no_crossing():
    """diag(1, -1) all along; held at y = 0 by a constraint only the 1 counts, and nothing is said."""
    opposite = lambda t, q, v, params: 0.5 * (v[0] ** 2 - v[1] ** 2) - jnp.exp(q[0] * q[1])
    states = (0.0, jnp.array([1.0, 0.0]), jnp.array([1.0, 0.0])), (1.0, jnp.array([2.0, 0.0]), jnp.array([1.0, 0.0]))
    found = said(opposite, *states)
    assert not found.crossed and "is -1 at the start, most in 'q[1]'" in found.cause
    assert said(opposite, *states, {"held": lj.Holonomic(lambda t, q, params: q[1])}) is None


def test_what_is_said_at_a_start():
    """Negative definite or indefinite, by the name of the worst coordinate; twins: definite, or so where it is free.

    The last one has positive 2 x 2 minors, and the eigenvalue 1 - 2 * 0.6.
    """
    hold, free = np.array([[0.0, 1.0]]), np.zeros((0, 2))
    of = lambda mass, rows=free: indefinite_in_words(np.asarray(mass), rows, lambda: ["a", "b", "c"]) or ""
    assert not of(np.diag([1.0, 2.0])) and not of(np.diag([1.0, -2.0]), hold) and not of(np.diag([1.0, 0.0]))
    assert "is negative definite where" in of(np.diag([-1.0, -2.0])) and "L = V - T" in of([[-1.0]], np.zeros((0, 1)))
    assert "not positive definite where the motion starts: its smallest eigenvalue is -2, most in 'b'" in of(
        np.diag([1.0, -2.0])
    )
    assert "is -0.2" in of(1.6 * np.eye(3) - 0.6, np.zeros((0, 3)))
    assert not of(np.diag([1.0, np.nan])) and "'b'" in of(np.diag([1.0, -2.0]), hold[:, ::-1])
    single = np.float32([[1.0, 1.0], [1.0, 1.0 - 1e-7]])
    assert not of(single) and of(np.asarray(single, float))
    again = lambda mass: indefinite_in_words(mass, free, lambda: ["a", "b"], again=True)
    assert again(np.diag([1.0, -2.0])) is not None and again(np.array([[1.0, 2.0], [2.0, 1.0]])) is None


@pytest.mark.slow
def test_a_motion_warns_once():
    """A mass below zero warns at the first motion of its kind, and by params at a later one; twin: above it never."""
    ball, ts = lj.System(lambda t, q, v, p: 0.5 * p["m"] * v**2 - q), np.array([0.0, 1.0])
    with warnings.catch_warnings(record=True) as given:
        warnings.simplefilter("always")
        traj = lj.integrate(ball, 0.0, 0.0, {"m": 2.0}, ts=ts)
        assert given == []
        up = lj.integrate(ball, 0.0, 0.0, {"m": -2.0}, ts=ts)
        lj.integrate(ball, 0.0, 0.0, {"m": -3.0}, ts=ts)
        (one,) = given
        assert "negative definite" in str(one.message) and one.filename == __file__
        jax.jit(lambda m: lj.integrate(ball, 0.0, 0.0, {"m": m}, ts=ts).q)(-2.0)
    assert len(given) == 1 and float(up.q[-1]) == -float(traj.q[-1]) == 0.25
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "the mass matrix is")
        lj.integrate(lj.System(lambda t, q, v, p: -0.5 * v**2), 0.0, 1.0, ts=ts)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the mass matrix is")
def test_the_message_of_a_motion_that_meets_it():
    """½ q v² from (1, -1) ends at t = 2/3; twins: a collision with positive mass, a stiff system with negative."""
    ts = np.array([0.0, 2.0])
    with pytest.raises(
        RuntimeError, match="stopped at t = 0.66666(.|\n)*mass matrix that is not positive(.|\n)*positive_definite"
    ):
        lj.integrate(lj.System(falling), 1.0, -1.0, ts=ts)
    collides = lj.System(lambda t, q, v, params: 0.5 * v**2 + 1 / q)
    with pytest.raises(RuntimeError, match="a singularity of the motion"):
        lj.integrate(collides, 1.0, 0.0, ts=ts)
    stiff = lj.System(
        lambda t, q, v, params: -0.5 * v**2 + 0.5 * q**2, dissipation=lambda t, q, v, params: -0.5e6 * v**2
    )
    with pytest.raises(RuntimeError, match="a stiff system"):
        lj.integrate(stiff, 1.0, 0.0, ts=5 * ts, max_steps=1000)
