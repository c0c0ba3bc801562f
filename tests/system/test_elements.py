"""What is wrong with elements is said by name, before anything runs."""

import numpy as np
import pytest

import lagjax as lj

above = lambda t, q, p: q
sliding = lambda t, q, v, p: v
three = lambda t, q, v, p: np.ones(3) * v
servo = lj.SampledControl(lambda t, q, v, p: -v["x"], 0.1)
energy = lambda t, q, v, p: 0.5 * v["x"] ** 2 + q["x"] * q["u"].sum()


def lagrangian(t, q, v, p):
    """A free particle."""
    return 0.5 * v**2


floor, rough = lj.Contact(above), lj.Contact(above, friction=0.1, sliding=sliding)
held, skids = lj.Holonomic(above), lj.Nonholonomic(sliding)
rubbed = lj.System(lagrangian, elements={"brake": lj.Friction(sliding, 0.1, normal="flour"), "floor": floor})
cart = lj.System(energy, elements={"u": servo})
lifted = lj.System(
    lambda t, q, v, p: 0.5 * v["x"] ** 2,
    states={"lift": lambda t, q, v, p: 1.0},
    elements={"floor": lj.Contact(lambda t, q, p: q["x"] - q["lift"])},
)


def moved(system, q=0.0, v=0.0, **options):
    """Ask for a motion."""
    return lj.integrate(system, q, v, ts=[0.0, 1.0], **options)


def held_by(constraints=None, **elements):
    """Ask for a motion of a particle with these elements."""
    return moved(lj.System(lagrangian, constraints, elements=elements))


VALUES = [
    # Signs, kinds and gaps in what is given.
    (lambda: lj.Contact(above, restitution=-0.5), "restitution = -0.5 is below zero"),
    (lambda: lj.Contact(above, restitution=1.5), r"(?s)restitution = 1.5 is above 1.*Fix: restitution=0.66"),
    (lambda: lj.Contact(above, friction=0.3), "friction is given, but sliding is not"),
    (lambda: lj.Friction(sliding, 0.5, -1.0), "normal = -1.0 is below zero"),
    (lambda: lj.Friction(sliding, np.nan, 1.0), "coefficient = nan is no number"),
    (lambda: lj.Friction(sliding, -1.0, 1.0), "coefficient = -1.0 is below zero"),
    (lambda: lj.Stop(above), "needs low, high"),
    (lambda: lj.Stop(above, low=2.0, high=1.0), "above high"),
    (lambda: lj.Elements({"floor": floor}, impacts="both"), "'sequential' or 'simultaneous', not 'both'"),
    (lambda: lj.CompliantContact(above, -1.0), "stiffness must be above zero, not -1.0"),
    (lambda: lj.CompliantContact(above, 1.0, -1.0), "damping = -1.0 is below zero"),
    (lambda: lj.CompliantContact(above, 1.0, sliding=sliding), "sliding is given, but friction is not"),
    (lambda: lj.SampledControl(sliding, 0.0), r"(?s)every must be above zero, not 0.0.*Fix: every=1.0"),
    (lambda: lj.SampledControl(sliding, np.nan), "every must be above zero, not nan"),
    (lambda: lj.SampledControl(sliding, 1.0, np.inf), "infinity in offset: inf"),
    # Names that clash or do not exist, shapes that differ.
    (lambda: moved(cart, {"x": 0.0}, {"x": 0.0}), r"(?s)q0 has no entry 'u'.*Fix: q0 = \{..., 'u': 0.0\}"),
    (lambda: moved(cart, {"x": 0.0, "u": np.zeros(2)}, {"x": 0.0}), r"of element 'u' must return .* shape \(\)"),
    (lambda: lj.System(energy, states={"u": three}, elements={"u": servo}),
     "'u' is the name of a state and of a lj.SampledControl"),
    (lambda: held_by({"floor": held}, floor=floor), "an element and a constraint, .* called 'floor'"),
    (lambda: held_by({"floor friction": skids}, floor=rough), "called 'floor friction'"),
    (lambda: held_by(**{"floor": rough, "floor friction": floor}), "called 'floor friction'"),
    (lambda: moved(rubbed), "normal of element 'brake' names 'flour', which is no constraint or contact; .*'floor'"),
    (lambda: held_by(floor=lj.Contact(above, friction=0.1, sliding=three)),
     r"sliding\(t, q, v, params\) of element 'floor' must return a number"),
    (lambda: held_by(brake=lj.Friction(three, 0.1, 1.0)), r"(?s)a number, .* or \(2,\) for .*jnp.full\(k, N\)"),
    (lambda: held_by(brake=lj.Friction(lambda t, q, v, p: abs(v), 0.1, 1.0)), "linear in v, but its slope depends on"),
    (lambda: moved(lifted, {"x": 1.0, "lift": 0.0}, {"x": 0.0}), "constraint 'floor' contains state 'lift'"),
    (lambda: moved(rubbed, start="floor"), "(?s)modes in which a motion with elements starts follow .*Fix: leave"),
]  # fmt: skip
KINDS = [
    (lambda: lj.Contact(1.0), "gap must be a function"),  # pyright: ignore
    (lambda: lj.System(lagrangian, elements={"floor": held}), "element 'floor' must be .* not a Holonomic"),  # pyright: ignore
    (lambda: lj.CompliantContact(above, 1.0, restitution=0.5), "restitution"),  # pyright: ignore
    (lambda: lj.SampledControl(1.0, 0.1), "controller must be a function"),  # pyright: ignore
    (lambda: lj.accelerations(rubbed, 0.0, 0.0, 0.0, None), "(?s)'brake', 'floor'.*lj.integrate takes elements"),
]
REFUSED = [*((*row, ValueError) for row in VALUES), *((*row, TypeError) for row in KINDS)]


@pytest.mark.parametrize(("call", "words", "error"), REFUSED)
def test_refused(call, words, error):
    """Elements that are none, beside others or by themselves; functions that take one form of equations refuse them."""
    with pytest.raises(error, match=words):
        call()


def test_what_they_are():
    """Systems print their elements; a control is a state; a stop has a gap on each side."""
    assert repr(rubbed) == "System(lagrangian; elements: brake (Friction), floor (Contact))"
    assert repr(cart) == "System(<lambda>; elements: u (SampledControl))" and list(cart.states) == ["u"]
    np.testing.assert_allclose(lj.Stop(above, -1.0, 1.0).gap(0.0, 0.25, None), [1.25, 0.75])
