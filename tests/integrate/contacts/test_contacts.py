"""Contacts that slip, let go and touch again; names and coefficients that cannot be are refused."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import optimize

import lagjax as lj
from tests.integrate.contacts.test_impacts import PARAMS, R, above, flying, on_wire, point, sliding
from tests.system.test_hybrid import G, in_phases


def after_impact(guard, system, *state):
    """The velocities after an impact."""
    return guard.reset.between(system, system)(0.0, *state)


def test_what_holds_goes_by_any_name():
    """A bead stays on its wire and halves its speed, whether the constraint's name sorts before the gap's or after."""

    @jax.jit
    def both(q, v, p):
        wires = [on_wire(name) for name in ("a wire", "wire")]
        return jnp.stack([after_impact(wire.switches[0].when, *wire.systems, q, v, p) for wire in wires])

    found = both(np.zeros(2), np.array([-8.0, -4.0]), {"mu": 0.1})
    np.testing.assert_allclose(found, [[4.0, 2.0]] * 2, rtol=1e-13)


def test_said_by_name():
    """Invalid friction is refused by name."""
    with pytest.raises(ValueError, match="friction is given, but sliding is not"):
        lj.touches(above, 0.5, friction=0.2)
    with pytest.raises(ValueError, match="sliding is given, but friction is not"):
        lj.touches(above, 0.5, sliding=sliding)
    with pytest.raises(ValueError, match="(?s)needs a restitution.*restitution=0.0"):
        lj.touches(above, friction=0.2, sliding=sliding)
    with pytest.raises(TypeError, match="sliding must be a function"):
        lj.touches(above, 0.5, friction=0.2, sliding=1.0)  # pyright: ignore
    q, v = {"x": 0.0, "y": R, "phi": 0.0}, {"x": 1.0, "y": -1.0, "phi": 0.0}
    for wrong, said in (
        (lambda t, q, v, p: jnp.stack([v["x"], v["y"]]), r"one number, but returned \(2,\)"),
        (lambda t, q, v, p: jnp.abs(v["x"]), "linear in v, but its slope depends on v"),
    ):
        guard = lj.touches(above, 0.5, friction=0.2, sliding=wrong)
        with pytest.raises(ValueError, match=said):
            jax.eval_shape(partial(after_impact, guard, flying), q, v, PARAMS)


SHAKEN = {"g": G, "a": 0.02, "w": 30.0}
over = lambda t, q, p: q - p["a"] * jnp.sin(p["w"] * t)
shaken = lj.System(lambda t, q, v, p: 0.5 * v**2 - p["g"] * q, {"table": lj.Holonomic(over)})


def on_a_table(leave, **options):
    """A body on a shaken table; `leave`: the switch that lets it go."""
    land = lj.Switch("flies", to="lies", when=lj.touches(over))
    hybrid = lj.Hybrid({"lies": shaken, "flies": point}, [leave, land], most_switches=4)
    return in_phases(hybrid, 0.0, 0.6, SHAKEN, ts=np.array([0.0, 0.1, 0.2]), estimate_error=False, **options)


@pytest.mark.exhaustive
def test_what_lets_go_may_touch_again():
    """A body leaves a shaken table at a² = g, flies, and lands. Twin: one that closes by 1e-9 never does."""
    traj = on_a_table(lj.Switch("lies", to="flies", when=lj.releases("table")), rtol=1e-11)
    w, a = SHAKEN["w"], SHAKEN["a"]
    leaves = np.arcsin(G / (a * w**2)) / w
    z, v = a * np.sin(w * leaves), a * w * np.cos(w * leaves)
    height = lambda s: z + v * s - 0.5 * G * s**2 - a * np.sin(w * (leaves + s))
    flight = float(np.asarray(optimize.brentq(height, 0.02, 0.19, xtol=1e-15)))
    np.testing.assert_allclose(traj.switches.t[:2], [leaves, leaves + flight], rtol=1e-10)
    assert list(traj.named_phases()) == ["lies", "flies", "lies"] and len(traj.switches) == 2
    assert abs(traj.switches.impulse[0]) < 1e-13
    with pytest.raises(RuntimeError, match="most_switches = 4"):
        on_a_table(lj.Switch("lies", to="flies", when=lj.releases("table"), reset=lambda t, q, v, p: v - 1e-9))
