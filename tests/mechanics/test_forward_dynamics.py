"""Systems that solve their own equations: checked against L, with constraints, in the user's words where wrong."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate.elements import in_modes
from lagjax.mechanics import equations_of
from lagjax.mechanics.saddle_point import ForwardDynamics
from lagjax.system import State, model_of
from tests.jaxtools.in_numpy import accelerations


def lagrangian(t, q, v, params):
    """A particle in the plane in polar coordinates, under its weight along x."""
    r, angle = q
    return params["m"] * ((v[0] ** 2 + (r * v[1]) ** 2) / 2 + 10.0 * r * jnp.cos(angle))


def polar(t, q, v, force, params):
    """Its accelerations, by hand."""
    r, angle = q
    radial = r * v[1] ** 2 + 10.0 * jnp.cos(angle) + force[0] / params["m"]
    return jnp.array([radial, (-2 * v[0] * v[1] - 10.0 * jnp.sin(angle) + force[1] / (params["m"] * r)) / r])


def without_coriolis(t, q, v, force, params):
    """The same without the term of r' and angle'."""
    return polar(t, q, jnp.array([0.0, 1.0]) * v, force, params)


Q, V, PARAMS = np.array([2.0, 0.3]), np.array([0.5, -1.0]), {"m": 3.0}
ROD = {"rod": lj.Holonomic(lambda t, q, params: q[0] ** 2 - 4.0)}


@pytest.mark.slow
def test_forward_dynamics_that_are_wrong():
    """A term left out is named, by the coordinate, also where the given velocity hides it, and in a motion."""
    system = lj.System(lagrangian, forward_dynamics=without_coriolis)
    for v in (V, 0 * V):
        with pytest.raises(ValueError, match="do not solve the equations of L: M a = F is missed by .* in 'q\\[1\\]'"):
            lj.accelerations(system, 0.0, Q, v, PARAMS)
    with pytest.raises(ValueError, match="do not solve the equations of L"):
        lj.integrate(system, Q, 0 * V, PARAMS, ts=jnp.linspace(0.0, 1.0, 3))


def test_forces_of_multipliers_and_elements():
    """Friction on a rod is solved with as L's equations are, and not without it; a system in modes keeps its f."""

    def rubbed(t, q, v, multipliers, params):
        return jnp.array([0.0, 1.0]) * 0.3 * multipliers["rod"] * q[0]

    found = []
    for f, force in ((polar, rubbed), (None, rubbed), (polar, None)):
        system = lj.System(lagrangian, ROD, force=force, forward_dynamics=f)
        found.append(accelerations(system, 0.0, Q, V * [0.0, 1.0], PARAMS))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(found[0][1]["rod"], found[1][1]["rod"], rtol=1e-13)
    assert np.abs(found[0][0] - found[2][0]).max() > 0.1
    wall = lj.Contact(lambda t, q, params: q[0] - 1.0, friction=0.3, sliding=lambda t, q, v, params: q[0] * v[1])
    for f in (polar, None):
        system = lj.System(lagrangian, elements={"wall": wall}, forward_dynamics=f)
        start = State(np.zeros(()), Q, V, {"m": np.array(3.0)})
        in_its_modes, laws = in_modes(system, start)
        solvers = []
        solver = lambda params: equations_of(model_of(in_its_modes, *start[:3], laws.at_first(start.t, params))).form
        jax.eval_shape(lambda params: solvers.append(solver(params)), start.params)
        assert isinstance(solvers[0], ForwardDynamics) == (f is polar)


def test_forward_dynamics_of_the_wrong_kind():
    """What is no function, takes other arguments, or returns something unlike q is refused in the user's words."""
    with pytest.raises(TypeError, match="forward_dynamics must be a function of \\(t, q, v, force, params\\)"):
        lj.System(lagrangian, forward_dynamics=3.0)
    for f, said in ((lambda t, q, v, params: q, "forward_dynamics"), (lambda *x: jnp.zeros(3), "one acceleration per")):
        system = lj.System(lagrangian, forward_dynamics=f)
        with pytest.raises((TypeError, ValueError), match=said):
            lj.accelerations(system, 0.0, Q, V, PARAMS)
    assert "forward dynamics" in lj.System(lagrangian, forward_dynamics=polar).functions().__repr__()
