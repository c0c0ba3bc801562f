"""What is wrong with elements is said by name, before anything runs."""

import numpy as np
import pytest

import lagjax as lj

above = lambda t, q, p: q
sliding = lambda t, q, v, p: v


def lagrangian(t, q, v, p):
    """A free particle."""
    return 0.5 * v**2


def test_bad_elements():
    """Signs, kinds and gaps in what is given."""
    with pytest.raises(ValueError, match="restitution = -0.5 is below zero"):
        lj.Contact(above, restitution=-0.5)
    with pytest.raises(ValueError, match=r"(?s)restitution = 1.5 is above 1.*Fix: restitution=0.66"):
        lj.Contact(above, restitution=1.5)
    with pytest.raises(ValueError, match="normal = -1.0 is below zero"):
        lj.Friction(sliding, 0.5, -1.0)
    with pytest.raises(ValueError, match="coefficient = nan is no number"):
        lj.Friction(sliding, np.nan, 1.0)
    with pytest.raises(ValueError, match="friction is given, but sliding is not"):
        lj.Contact(above, friction=0.3)
    with pytest.raises(TypeError, match="gap must be a function"):
        lj.Contact(1.0)  # pyright: ignore
    with pytest.raises(ValueError, match="coefficient = -1.0 is below zero"):
        lj.Friction(sliding, -1.0, 1.0)
    with pytest.raises(ValueError, match="needs low, high"):
        lj.Stop(above)
    with pytest.raises(ValueError, match="above high"):
        lj.Stop(above, low=2.0, high=1.0)
    with pytest.raises(TypeError, match="element 'floor' is a Holonomic"):
        lj.System(lagrangian, elements={"floor": lj.Holonomic(above)})  # pyright: ignore
    with pytest.raises(ValueError, match="one of 'sequential'"):
        lj.Elements({"floor": lj.Contact(above)}, impacts="both")
    np.testing.assert_allclose(lj.Stop(above, -1.0, 1.0).gap(0.0, 0.25, None), [1.25, 0.75])


def test_bad_springs_and_controls():
    """Signs, kinds, shapes and names of compliant contacts and sampled controls."""
    with pytest.raises(ValueError, match="stiffness = -1.0 is not above zero"):
        lj.CompliantContact(above, -1.0)
    with pytest.raises(ValueError, match="damping = -1.0 is below zero"):
        lj.CompliantContact(above, 1.0, -1.0)
    with pytest.raises(TypeError, match="restitution"):
        lj.CompliantContact(above, 1.0, restitution=0.5)  # pyright: ignore
    with pytest.raises(ValueError, match="sliding is given, but friction is not"):
        lj.CompliantContact(above, 1.0, sliding=sliding)
    with pytest.raises(ValueError, match=r"(?s)every = 0.0 is not above zero.*Fix: every=1.0"):
        lj.SampledControl(sliding, 0.0)
    with pytest.raises(ValueError, match="every = nan is not above zero"):
        lj.SampledControl(sliding, np.nan)
    with pytest.raises(ValueError, match="offset = inf is no time"):
        lj.SampledControl(sliding, 1.0, np.inf)
    with pytest.raises(TypeError, match="controller must be a function"):
        lj.SampledControl(1.0, 0.1)  # pyright: ignore
    servo = lj.SampledControl(lambda t, q, v, p: -v["x"], 0.1)
    energy = lambda t, q, v, p: 0.5 * v["x"] ** 2 + q["x"] * q["u"].sum()
    cart = lj.System(energy, elements={"u": servo})
    assert repr(cart) == "System(<lambda>; elements: u (SampledControl))" and list(cart.states) == ["u"]
    with pytest.raises(ValueError, match=r"(?s)q0 has no entry 'u'.*Fix: q0 = \{..., 'u': 0.0\}"):
        lj.integrate(cart, {"x": 0.0}, {"x": 0.0}, ts=[0.0, 1.0])
    with pytest.raises(ValueError, match=r"controller\(t, q, v, params\) of element 'u' must return .* shape \(\)"):
        lj.integrate(cart, {"x": 0.0, "u": np.zeros(2)}, {"x": 0.0}, ts=[0.0, 1.0])
    with pytest.raises(ValueError, match="'u' is the name of a state and of a lj.SampledControl"):
        lj.System(energy, states={"u": lambda t, q, v, p: 0.0}, elements={"u": servo})


def test_bad_systems():
    """Names that clash or do not exist, shapes that differ; functions that take one form of equations refuse them."""
    floor = lj.Contact(above)
    with pytest.raises(ValueError, match="'floor' is the name of an element and of a constraint"):
        lj.integrate(
            lj.System(lagrangian, {"floor": lj.Holonomic(above)}, elements={"floor": floor}), 0.0, 0.0, ts=[0.0, 1.0]
        )
    rubbed = lj.System(lagrangian, elements={"brake": lj.Friction(sliding, 0.1, normal="flour"), "floor": floor})
    with pytest.raises(
        ValueError, match="normal='flour' of element 'brake' is no constraint and no contact; .*'floor'"
    ):
        lj.integrate(rubbed, 0.0, 0.0, ts=[0.0, 1.0])
    rough = lj.Contact(above, friction=0.1, sliding=sliding)
    for clash in (
        {"constraints": {"floor friction": lj.Nonholonomic(sliding)}},
        {"elements": {"floor friction": floor}},
    ):
        both = lj.System(lagrangian, clash.get("constraints"), elements={"floor": rough, **clash.get("elements", {})})
        with pytest.raises(ValueError, match="'floor friction' is the name of"):
            lj.integrate(both, 0.0, 0.0, ts=[0.0, 1.0])
    three = lambda t, q, v, p: np.ones(3) * v
    with pytest.raises(ValueError, match=r"sliding\(t, q, v, params\) of element 'floor' must return a number"):
        lj.integrate(
            lj.System(lagrangian, elements={"floor": lj.Contact(above, friction=0.1, sliding=three)}),
            0.0, 0.0, ts=[0.0, 1.0],
        )  # fmt: skip
    with pytest.raises(ValueError, match=r"(?s)a number, as its normal force, or \(2,\) for .*jnp.full\(k, N\)"):
        lj.integrate(lj.System(lagrangian, elements={"brake": lj.Friction(three, 0.1, 1.0)}), 0.0, 0.0, ts=[0.0, 1.0])
    speed = lj.System(lagrangian, elements={"brake": lj.Friction(lambda t, q, v, p: abs(v), 0.1, 1.0)})
    with pytest.raises(ValueError, match="linear in v, but its slope depends on v"):
        lj.integrate(speed, 0.0, 0.0, ts=[0.0, 1.0])
    lifted = lj.System(
        lambda t, q, v, p: 0.5 * v["x"] ** 2,
        states={"lift": lambda t, q, v, p: 1.0},
        elements={"floor": lj.Contact(lambda t, q, p: q["x"] - q["lift"])},
    )
    with pytest.raises(ValueError, match="constraint 'floor' contains state 'lift'"):
        lj.integrate(lifted, {"x": 1.0, "lift": 0.0}, {"x": 0.0}, ts=[0.0, 1.0])
    with pytest.raises(TypeError, match="(?s)'brake', 'floor'.*lj.integrate takes elements"):
        lj.accelerations(rubbed, 0.0, 0.0, 0.0, None)
    with pytest.raises(ValueError, match="(?s)modes in which a motion with elements starts follow from q0.*Fix: leave"):
        lj.integrate(rubbed, 0.0, 0.0, ts=[0.0, 1.0], start="floor")
    assert repr(rubbed) == "System(lagrangian; elements: brake (Friction), floor (Contact))"
