"""Typical first mistakes: the error is one paragraph with what happened, the usual cause, and the fix as code.

All of these but the film fail before anything is compiled.
"""

import math
import re

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special

import lagjax as lj
from tests.systems import motion

TS = np.linspace(0.0, 1.0, 5)
PARAMS = {"m": 1.5, "g": 9.81}
START = {"theta": 1.0}, {"theta": 0.0}
POINT = {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}


def swing(t, q, v, params):
    """A pendulum of length 1."""
    return params["m"] * (0.5 * v["theta"] ** 2 + params["g"] * jnp.cos(q["theta"]))


def point(t, q, v, params):
    """A point in a vertical plane."""
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]


pendulum = lj.System(swing)


def move(lagrangian, start=START, params=PARAMS, **options):
    """Integrate a system or a Lagrangian."""
    system = lagrangian if isinstance(lagrangian, lj.System) else lj.System(lagrangian)
    return lj.integrate(system, *start, params, **{"ts": TS} | options)


def swept(run):
    """A sweep over masses."""
    return lj.sweep(run, {"m": [1.0, 2.0]}, progress=False)


def constrained(g, kind=lj.Holonomic):
    """Integrate the point under a constraint."""
    return move(lj.System(point, {"rod": kind(g)}), POINT)


def by_numpy(t, q, v, params):
    """NumPy in place of jax.numpy."""
    return 0.5 * v["theta"] ** 2 + params["g"] * np.cos(q["theta"])


def by_math(t, q, v, params):
    """The module math in place of jax.numpy."""
    return 0.5 * v["theta"] ** 2 + params["g"] * math.cos(q["theta"])


def by_float(t, q, v, params):
    """A Python number made from a coordinate."""
    return 0.5 * v["theta"] ** 2 + float(q["theta"])


def with_if(t, q, v, params):
    """A potential by cases."""
    if q["theta"] > 0:
        return 0.5 * v["theta"] ** 2
    return 0.5 * v["theta"] ** 2 - 1.0


def without_return(t, q, v, params):
    """An energy that is not returned."""
    0.5 * v["theta"] ** 2


def attributes(t, q, v, params):
    """Coordinates as attributes."""
    return 0.5 * v.theta**2


def without_time(q, v, params):
    """A missing argument."""
    return 0.5 * v["theta"] ** 2


def of_a_vector(t, q, v, params):
    """Energies that are not summed."""
    return 0.5 * v**2 + jnp.cos(q)


def needs_mass(t, q, v, params):
    """A parameter by another name."""
    return 0.5 * params["mass"] * v["theta"] ** 2


def counts(t, q, v, params):
    """A sum over a number of terms given in params."""
    return 0.5 * v["theta"] ** 2 - sum(q["theta"] ** i for i in range(params["n"]))


def taken_apart(t, q, v, params):
    """A dictionary unpacked into variables."""
    (rate,) = v
    return 0.5 * rate**2


def unpacked(t, q, v, params):
    """A vector of two unpacked into its entries."""
    x, y = v
    return 0.5 * (x**2 + y**2)


def changed(t, q, v, params):
    """An array modified in place."""
    v[0] = 0.0
    return 0.5 * v @ v


def by_sympy(t, q, v, params):
    """A function for symbols."""
    import sympy

    return 0.5 * v["theta"] ** 2 + sympy.cos(q["theta"])


with_length = lj.System(point, {"rod": lj.Holonomic(lambda t, q, p: q["x"] - p["l"])})
VALUE, TYPE = ValueError, TypeError
NUMPY = r"NumPy cannot be differentiated"
MISTAKES = {
    "another name in v": (lambda: move(swing, ({"theta": 1.0}, {"thta": 0.0})), VALUE, "structure of q", "v: thta"),
    "v a number": (lambda: move(swing, ({"theta": 1.0}, 0.0)), VALUE, "q: theta", "v: no names", "zeros_like"),
    "a condition": (lambda: move(swing, ({"theta": True}, {"theta": 0})), TYPE, "'theta' of q is bool", "1.0"),
    "text": (lambda: move(swing, ({"theta": "1"}, {"theta": 0})), TYPE, "'theta' of q is '1'", "from a file"),
    "params before v": (
        lambda: move(swing, (START[0], PARAMS), START[1]), VALUE, "structure of q", "another order", "q0, v0, params"),
    "q and v before t": (
        lambda: lj.accelerations(pendulum, *START, 0.0, PARAMS), TYPE, "one number, not {'theta': 1.0}", "t, q, v"),
    "the system last": (
        lambda: lj.integrate(*START, PARAMS, pendulum, ts=TS), TYPE, "not {", "argument 4 here", "system, q0, v0"),
    "times by place": (
        lambda: lj.integrate(pendulum, *START, PARAMS, TS), TYPE, "without ts=", "by position", r"params, ts=ts\)"),
    "times as params": (lambda: move(swing, params=TS), TYPE, "'m' of params", r"shape \(5,\)", "another order"),
    "L in another order": (
        lambda: move(lambda q, v, t, params: 0.5 * v["theta"] ** 2), TYPE, r"f\(q, v, t, params\)", r"def f\(t, q, v"),
    "a constraint in another order": (
        lambda: constrained(lambda q, t, params: q["x"]), TYPE, "'rod'", r"f\(q, t, params\)", r"def f\(t, q, params"),
    "another order by other names": (
        lambda: move(lambda x, u, s, p: 0.5 * u["theta"] ** 2 - x["theta"]), TYPE, "'theta' of t", r"def f\(t, q, v"),
    "no params": (lambda: move(swing, params=None), TYPE, "none were given", r"ts=ts\)"),
    "a parameter left out": (
        lambda: move(swing, params={"m": 1.0}), VALUE, "'g', and there is none: params has 'm'", '"g": 1.0'),
    "a parameter misspelt": (
        lambda: move(needs_mass, params={"masss": 1.0}), VALUE, "'mass'", r'params\["mass"\]', "write 'masss'"),
    "a coordinate misspelt": (
        lambda: move(swing, ({"thteta": 1.0}, {"thteta": 0.0})), VALUE, "has 'thteta'", 'q0 = {"theta": 0.1}'),
    "a start without names": (lambda: move(swing, (1.0, 0.0)), TYPE, "'theta' of an array", 'q0 = {"theta": 0.1}'),
    "a list": (lambda: move(of_a_vector, ([1.0], [0.0])), TYPE, "with a list", r"q0 = jnp.array\("),
    "an array beside a list": (
        lambda: move(of_a_vector, (np.ones(2), [0.0, 0.0])), VALUE, "an array for one and a list", r"jnp.array\("),
    "entries of a number": (
        lambda: move(lambda t, q, v, p: 0.5 * v[0] ** 2, (1.0, 0.0)), TYPE, "of a single number", "q in place of q"),
    "too few entries": (
        lambda: move(lambda t, q, v, p: 0.5 * v[2] ** 2, ([1.0, 1.0], [0.0, 0.0])), TYPE, "a list of 2", "one entry"),
    "too many to unpack": (
        lambda: move(unpacked, (np.ones(3), np.ones(3))), TYPE, r"q is an array of shape \(3,\)", r"x, y = v"),
    "an entry of a dict": (
        lambda: move(lambda t, q, v, p: 0.5 * v[0] ** 2), VALUE, "asks for 0", "for an array", r"v\['theta'\]"),
    "a dict taken apart": (lambda: move(taken_apart), TYPE, "with text", "gives the names", r"q\['theta'\]"),
    "an entry changed": (lambda: move(changed, (np.ones(2), np.zeros(2))), TYPE, r"v\[0\] = 0.0", r"x.at\[i\].set"),
    "shapes that differ": (
        lambda: move(lambda t, q, v, p: v @ jnp.ones(3), (np.ones(2), np.zeros(2))), TYPE,
        r"shapes \(2,\) and \(3,\)", r"q is an array of shape \(2,\)"),
    "attributes of an array": (lambda: move(attributes, (1.0, 0.0)), TYPE, ".theta of an array", r'v\["theta"\]'),
    "a power": (lambda: move(lambda t, q, v, p: 0.5 * v["theta"] ^ 2), TYPE, "not a power", r"v\*\*2"),
    "a count as a float": (lambda: move(counts, params={"n": 3.0}), TYPE, "not a whole number", '"n": 3'),
    "a count in an array": (lambda: move(counts, params={"n": jnp.array(3)}), TYPE, "not known while JAX", '"n": 3'),
    "entries by a condition": (
        lambda: move(lambda t, q, v, p: jnp.sum(v[v > 0] ** 2), (np.ones(2), np.ones(2))), TYPE, "how many", "where"),
    "params as a list": (lambda: move(swing, params=[1.5, 9.81]), TYPE, "params, which is a list", '"m": 1.0'),
    "SciPy": (
        lambda: move(lambda t, q, v, p: 0.5 * scipy.special.j0(q["theta"])), TYPE, NUMPY, "jax.scipy.special.j0"),
    "SymPy": (lambda: move(by_sympy), TYPE, "SymPy", "jnp.cos"),
    "a vector of one": (
        lambda: move(of_a_vector, (np.ones(1), np.zeros(1))), VALUE, r"shape \(1,\)", "jnp.sum", "q0 = 0.1"),
    "float32": (
        lambda: move(swing, jax.tree.map(np.float32, START), rtol=1e-10), VALUE, "float32", "jax_enable_x64"),
    "times out of order": (
        lambda: move(swing, ts=np.array([0.0, 2.0, 1.0, 3.0])), VALUE, "must increase", r"jnp.unique\(ts\)"),
    "one time": (lambda: move(swing, ts=10.0), VALUE, r"starts at ts\[0\]", "linspace"),
    "a matrix of constraints": (
        lambda: constrained(lambda t, q, params: q["x"] * jnp.eye(2)), VALUE, "'rod'", r"\(2, 2\)", "jnp.stack"),
    "a constraint without an equation": (
        lambda: constrained(lambda t, q, params: q["x"] * jnp.zeros(0)), VALUE, "'rod'", r"one equation.*shape \(0,\)"),
    "an equation for a residual": (
        lambda: constrained(lambda t, q, params: q["x"] == 1.0), VALUE, "'rod'", "returned shape .*bool", r"- l\*\*2"),
    "a constraint of the velocity": (
        lambda: constrained(lambda t, q, v, params: q["x"]), TYPE, "'rod'", "3 arguments", r"def f\(t, q, params"),
    "a rolling condition without v": (
        lambda: constrained(lambda t, q, params: q["x"], lj.Nonholonomic), TYPE, "'rod'",
        r"def f\(t, q, v, params"),
    "a constraint's parameter": (
        lambda: constrained(lambda t, q, p: q["x"] - p["l"]), VALUE, "'rod'", "'l'", "has 'm', 'g'|has 'g', 'm'"),
    "a constraint by NumPy": (
        lambda: constrained(lambda t, q, p: np.sqrt(q["x"])), TYPE, "'rod'", NUMPY, "jnp.sqrt"),
    "NumPy": (lambda: move(by_numpy), TYPE, r"L\(t, q, v, params\)", NUMPY, r'np.cos\(q\["theta"\]\)', "jnp.cos"),
    "math": (lambda: move(by_math), TYPE, "Python number", "jnp.cos in place of math.cos"),
    "float": (lambda: move(by_float), TYPE, "Python number", "leave out float"),
    "if": (lambda: move(with_if), TYPE, "branches on", r'if q\["theta"\] > 0', "jnp.where"),
    "a pair of energies": (lambda: move(lambda t, q, v, p: (0.5, 1.0)), VALUE, "a tuple", "one by one", "kinetic -"),
    "energies by name": (lambda: move(lambda t, q, v, p: {"T": 0.5}), VALUE, "a dict", "one by one", "kinetic -"),
    "a whole number": (lambda: move(lambda t, q, v, p: 1), VALUE, "returned 1, ", "in place of an energy"),
    "a comparison": (lambda: move(lambda t, q, v, p: v["theta"] > 0), VALUE, "bool", "in place of an energy"),
    "a complex energy": (lambda: move(lambda t, q, v, p: v["theta"] * 1j), VALUE, "complex", "jnp.real"),
    "a force without return": (
        lambda: move(lj.System(swing, force=lambda t, q, v, p: None)), VALUE, "force", "it has None"),
    "no return": (lambda: move(without_return), VALUE, "returned None", "return kinetic - potential"),
    "attributes": (lambda: move(attributes), TYPE, ".theta of a dict", r'v\["theta"\]'),
    "no time": (lambda: move(without_time), TYPE, "4 arguments", r"without_time\(q, v, params\)", "def without_time"),
    "a force for one coordinate": (
        lambda: move(lj.System(point, force=lambda t, q, v, params: -v["x"]), POINT), VALUE, "like q", "0.0 where"),
    "a friction's parameter": (
        lambda: move(lj.System(swing, dissipation=lambda t, q, v, p: p["c"] * v["theta"] ** 2)), VALUE,
        r"dissipation\(t, q, v, params\) asks for 'c'", '"c": 1.0'),
    "our solver's class": (lambda: move(swing, method=lj.Radau5), TYPE, r"method=lj.Radau5\(\)"),
    "diffrax's solver's class": (lambda: move(swing, method=diffrax.Dopri5), TYPE, r"method=diffrax.Dopri5\(\)"),
    "a solver's name": (lambda: move(swing, method="RK45"), TYPE, "not 'RK45'", r"lj.Dopri8\(\)"),
    "a parameter read as text": (
        lambda: move(swing, params=PARAMS | {"g": "9.81"}), TYPE, "with 'g' of params", '"g": 1.0'),
    "params as a whole": (
        lambda: move(lambda t, q, v, params: v["theta"] ** 2 - params * q["theta"]), TYPE, "with a dict", "'g'|'m'"),
    "amplitudes": (lambda: move(swing, ({"theta": 1j}, {"theta": 0j})), TYPE, "is complex", "jnp.real"),
    "an axis by another name": (
        lambda: swept(lambda point: point["mass"]), VALUE, r"run\(point\) asks for 'mass'", "point has 'm'", "axes ="),
    "an axis as an attribute": (lambda: swept(lambda point: point.m**2), TYPE, ".m of a dict", r'point\["m"\]'),
    "a point for a number": (lambda: swept(lambda m: m**2), TYPE, "with a dict", r"point\['m'\]"),
    "axes one by one": (lambda: swept(lambda m, g: m * g), TYPE, "with 1 argument,", r"f\(m, g\)", r"f\(point\)"),
    "float in a sweep": (lambda: swept(lambda p: float(p["m"])), TYPE, "Python number", "leave out float"),
    "a film of q alone": (
        lambda: motion("rod pendulum").animate(lambda q: (q["x"], 0.0)), TYPE, r"positions\(t, q, params\)",
        r"def f\(t, q, params\)"),
    "the state of the explanation": (
        lambda: lj.explain(lj.System(by_numpy), 0.0, *START, PARAMS), TYPE, NUMPY, "jnp.cos"),
    "one acceleration": (
        lambda: lj.accelerations(lj.System(needs_mass), 0.0, *START, PARAMS), VALUE, "'mass'", "'m'"),
    "the nearest state": (
        lambda: lj.consistent_state(with_length, 0.0, *POINT, PARAMS),
        VALUE, "'rod'", "'l'"),
    "one residual": (lambda: lj.constraint_residual(with_length, 0.0, *POINT, PARAMS), VALUE, "'rod'", "'l'"),
}  # fmt: skip


@pytest.mark.parametrize("mistake", MISTAKES)
def test_says_what_happened_and_what_to_do(mistake):
    """One paragraph with the user's names, a usual cause and a fix, without JAX internals."""
    act, kind, *parts = MISTAKES[mistake]
    with pytest.raises(kind) as caught:
        act()
    said = str(caught.value)
    for part in (*parts, "Usual cause: ", "Fix: "):
        assert re.search(part, said), f"{part!r} is not in:\n{said}"
    assert said.index("Usual cause") < said.index("Fix") and len(said.splitlines()) <= 6 and "\n\n" not in said
    assert "racer" not in said and "PyTreeDef" not in said and "/" not in said.replace("[q]/[t]", "")


def test_the_check_can_fail():
    """Twin: JAX's own message would fail the check, and correct functions raise nothing."""
    with pytest.raises(jax.errors.TracerArrayConversionError) as caught:
        jax.eval_shape(by_numpy, 0.0, *START, PARAMS)
    assert "Fix: " not in str(caught.value)
    lj.momentum(pendulum, 0.0, *START, PARAMS)


def test_closed_over_parameters_work():
    """Parameters that L closes over are not an error."""
    length = 2.0
    closed = lj.System(lambda t, q, v, params: 0.5 * (length * v["theta"]) ** 2)
    assert float(lj.momentum(closed, 0.0, {"theta": 0.0}, {"theta": 1.5}, None)["theta"]) == 6.0


def test_callables_of_any_kind():
    """Objects with __call__, partial and compiled functions work like functions."""
    import functools

    class Swing:
        def __call__(self, t, q, v, params):
            return swing(t, q, v, params)

    for lagrangian in (
        Swing(),
        jax.jit(swing),
        functools.partial(lambda m, t, q, v, params: m * swing(t, q, v, params), 1.0),
    ):
        assert float(lj.momentum(lj.System(lagrangian), 0.0, *START, PARAMS)["theta"]) == 0.0
    with pytest.raises(ValueError, match="'mass'"):
        lj.momentum(lj.System(functools.partial(needs_mass)), 0.0, *START, PARAMS)


def test_degrees():
    """`explain` tells angles of more than a turn; twin: a length of as much, and smaller angles, are no matter."""
    system = lj.System(lambda t, q, v, params: 0.5 * (v["a"] ** 2 + v["x"] ** 2) + jnp.cos(q["a"]) - q["x"] ** 2)
    said = lambda a, x: str(lj.explain(system, 0, {"a": a, "x": x}, {"a": 0, "x": 0}))
    assert re.search(r"angles +in radians: a = 90 is 14.3 turns; for degrees use jnp.radians\(...\)", said(90, 90))
    assert "radians" not in said(1, 90)
