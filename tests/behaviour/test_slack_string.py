"""A pendulum on a string, which goes slack when its tension ends, and taut again with a jerk.

Thrown from the bottom with v₀² between 2 g l and 5 g l it leaves the circle at the angle φ above the horizontal, where
v² = g l sin φ, that is sin φ = (v₀² - 2 g l) / (3 g l). On its parabola x² + y² - l² = t³ (¼ g² t - g v cos φ): the
gap opens as t³, and the string is taut again after t = 4 v cos φ / g, at the angle -3 φ of the circle.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate as quadrature

import lagjax as lj

L, G = 0.75, 9.81


def lagrangian(t, q, v, params):
    """The Lagrangian of a body of unit mass."""
    return 0.5 * jnp.sum(v**2) - G * q[1]


def gap(t, q, params):
    """The length of string left before it is taut."""
    return L - jnp.hypot(q[0], q[1])


string = lj.Hybrid(
    {"taut": lj.System(lagrangian, {"string": lj.Holonomic(gap)}), "slack": lj.System(lagrangian)},
    [lj.Switch("taut", to="slack", when=lj.releases("string")), lj.Switch("slack", to="taut", when=lj.touches(gap))],
    most_switches=4,
)


def thrown(speed, until=1.2):
    """The pendulum thrown from the bottom to the right."""
    start = jnp.array([0.0, -L]), jnp.array([speed, 0.0])
    traj = lj.integrate(string, *start, ts=jnp.array([0.0, until]), rtol=1e-11, estimate_error=False)
    assert isinstance(traj, lj.HybridTrajectory)
    return traj


@pytest.mark.exhaustive
def test_slack_and_taut():
    """Times, places and the remaining velocity against closed forms. Twin: those of another speed differ."""
    speed = np.sqrt(3.0 * G * L)
    traj = thrown(speed)
    assert traj.switches.to[:2].tolist() == [1, 0] and len(traj.switches) == 2
    phi = np.arcsin(1 / 3)
    v = np.sqrt(G * L * np.sin(phi))
    rate = lambda angle: np.sqrt(speed**2 - 2 * G * L * (1 - np.cos(angle))) / L
    slack, _ = quadrature.quad(lambda angle: 1 / rate(angle), 0.0, np.pi / 2 + phi, epsabs=1e-13)
    on_circle = lambda angle: L * np.array([np.cos(angle), np.sin(angle)])
    along = lambda angle: np.array([-np.sin(angle), np.cos(angle)])
    flight = 4 * v * np.cos(phi) / G
    np.testing.assert_allclose(traj.switches.t[:2], [slack, slack + flight], rtol=1e-9)
    np.testing.assert_allclose(traj.switches.q[0], on_circle(phi), rtol=1e-9)
    np.testing.assert_allclose(traj.switches.q[1], on_circle(-3 * phi), rtol=1e-8)
    falling = v * along(phi) - np.array([0.0, G * flight])
    np.testing.assert_allclose(traj.switches.v[1], falling, rtol=1e-8)
    kept = (falling @ along(-3 * phi)) * along(-3 * phi)
    np.testing.assert_allclose(traj.switches.v_after[1], kept, rtol=1e-8)
    np.testing.assert_allclose(traj.switches.impulse[1], kept - falling, rtol=1e-8)
    assert abs(thrown(1.01 * speed).switches.t[1] / (slack + flight) - 1) > 1e-3
