"""Systems from SymPy: compared with SymPy's own equations, SciPy's integrator, closed forms, and systems by hand.

Exported programs that integrate, run by a process that has only JAX and NumPy.
"""

import copy
import dataclasses
import json
import pickle
import subprocess
import sys
import textwrap
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import sympy as sp
from jax import export
from sympy.codegen.cfunctions import Sqrt, log1p
from sympy.physics import mechanics as me

import lagjax as lj
from lagjax.exchange import plain
from tests.by_numpy import by_numpy, equations
from tests.systems import HORIZONTAL, PARAMS, motion, pendulum, rod_pendulum

t = sp.Symbol("t")
x, y, theta, phi, angle = me.dynamicsymbols("x y theta phi angle")
m, g, l, c, k = symbols = sp.symbols("m g l c k", positive=True)
KINETIC, POTENTIAL = m * (x.diff() ** 2 + y.diff() ** 2) / 2, m * g * y


def method_of_a_rod():
    """A mass on a rod, in x and y, with air drag, as a `LagrangesMethod`."""
    N, P = me.ReferenceFrame("N"), me.Point("P")
    P.set_vel(N, x.diff() * N.x + y.diff() * N.y)
    drag = [(P, -c * P.vel(N))]
    rod = [x**2 + y**2 - l**2]
    return me.LagrangesMethod(KINETIC - POTENTIAL, [x, y], forcelist=drag, frame=N, hol_coneqs=rod)


def test_constraints_of_lagranges_method():
    """Accelerations with drag and the multiplier equal SymPy's, whose `lam1` has the opposite sign."""
    method, params = method_of_a_rod(), {"m": 1.5, "g": 9.75, "l": 1.25, "c": 0.5}
    state = {x: 0.75, y: -1.0, x.diff(): 2.0, y.diff(): 1.5}
    system = lj.from_sympy(method, parameters=[m, g, l, c])
    assert {name: constraint.kind for name, constraint in system.constraints.items()} == {"constraint1": "holonomic"}
    a, multipliers = lj.accelerations(system, 0.0, {"x": 0.75, "y": -1.0}, {"x": 2.0, "y": 1.5}, params)
    method.form_lagranges_equations()
    numbers = state | {p: params[p.name] for p in (m, g, l, c)}
    number = lambda matrix: np.array(matrix.subs(numbers).evalf(), float)
    # SymPy's unknowns: q', q'' and the multipliers.
    *_, ax, ay, multiplier = np.linalg.solve(number(method.mass_matrix_full), number(method.forcing_full))[:, 0]
    np.testing.assert_allclose([a["x"], a["y"], multipliers["constraint1"]], [ax, ay, multiplier], rtol=1e-13)
    solved = method.solve_multipliers(op_point=numbers)
    np.testing.assert_allclose(multipliers["constraint1"], -float(solved[method.lam_vec[0]]), rtol=1e-13)
    # By hand, including the sign: the rod pulls with m v²/l + m g cos(angle), towards the pivot, and ∂g/∂q points away.
    pull = 1.5 * 6.25 / 1.25 + 1.5 * 9.75 * 1.0 / 1.25
    np.testing.assert_allclose(multipliers["constraint1"], -pull / (2 * 1.25), rtol=1e-13)


def test_knife_edge():
    """A blade on a slope: a constraint of velocities, the force across the blade; on its way along the slope none."""
    J = sp.Symbol("J")
    edge = x.diff() * sp.sin(angle) - y.diff() * sp.cos(angle)
    method = me.LagrangesMethod(KINETIC + J * angle.diff() ** 2 / 2 + m * g * x, [x, y, angle], nonhol_coneqs=[edge])
    system = lj.from_sympy(method, parameters=[m, g, J])
    assert system.constraints["constraint1"].kind == "velocity"
    # Along the blade g cos(angle), across it the speed times the rate of turning.
    turned, speed, rate, slope = 0.5, 1.5, 2.0, 4.5
    c, s = np.cos(turned), np.sin(turned)
    at = {"x": 0.0, "y": 0.0, "angle": turned}, {"x": speed * c, "y": speed * s, "angle": rate}
    a = equations(system, 0.0, *at, {"m": 2.0, "g": slope, "J": 0.5}).a
    along, across = slope * c, speed * rate
    np.testing.assert_allclose([a["x"], a["y"]], [along * c - across * s, along * s + across * c], rtol=1e-13)
    assert a["angle"] == 0.0


def test_time_forces_and_dissipation():
    """Explicit time, Q and R, a rigid body: m a = m Ω² x + F cos 3t - c v - k v, I α = -torque."""
    N, B, P = me.ReferenceFrame("N"), me.ReferenceFrame("B"), me.Point("P")
    B.orient_axis(N, theta, N.z)
    P.set_vel(N, 0)
    wheel = me.RigidBody("wheel", P, B, m, (me.inertia(B, 0, 0, m * l**2), P))
    turned = [x * sp.cos(sp.sin(t)), x * sp.sin(sp.sin(t))]
    L = me.Lagrangian(N, wheel) + m * sum(place.diff(t) ** 2 for place in turned) / 2
    force = {x: g * sp.cos(3 * t) - c * x.diff(t)}
    system = lj.from_sympy(
        L, [x, theta], [m, g, l, c, k], force=force, dissipation=k * x.diff(t) ** 2 / 2 + theta.diff()
    )
    params = {"m": 2.0, "g": 3.0, "l": 0.5, "c": 0.25, "k": 0.125}
    a, _ = lj.accelerations(system, 0.5, {"x": 1.5, "theta": 0.0}, {"x": -2.0, "theta": 1.0}, params)
    expected = np.cos(0.5) ** 2 * 1.5 + (3.0 * np.cos(1.5) + (0.25 + 0.125) * 2.0) / 2.0
    np.testing.assert_allclose([a["x"], a["theta"]], [expected, -1 / (2.0 * 0.25)], rtol=1e-13)


HERTZ = sp.Piecewise((0, x < 0), (k * x ** sp.Rational(5, 2), True))
ROOTS = sp.Piecewise((sp.sqrt(-x), x < 0), (sp.log(x), x < 1), (1 / x, True))
EXPRESSIONS = [
    HERTZ, ROOTS, sp.Abs(x), sp.sign(x) * x, sp.atan2(x, y), sp.Max(x, y, 0), sp.Min(x, 2, y), sp.Heaviside(x) * x,
    sp.Abs(y) ** sp.Rational(1, 3), sp.Abs(y) ** sp.Rational(-5, 2), sp.pi * x + sp.E + sp.EulerGamma, sp.sqrt(2) * x,
    x**-3, sp.Abs(x) ** k, 2**x, sp.Mod(x, k), sp.floor(x) * x, sp.ceiling(x) * x, sp.sec(x) + sp.cot(x), sp.coth(x),
    sp.sinc(x), sp.erf(x), sp.gamma(x + 2), sp.exp(-(x**2)), 10**12 * x, sp.Rational(10**20, 3) * x, sp.Float(0.1) * x,
    sp.Piecewise((x, sp.And(x > 0, y > 0)), (y, sp.Or(x < 0, sp.Not(y > 1))), (1, True)), sp.asin(x / 4),
    x * sp.Sum(k ** sp.Symbol("n"), (sp.Symbol("n"), 0, 3)), sp.Matrix([x, y]).norm(), sp.acosh(x + 3), -(x - y) / (-k),
    k / (l / x), (l * y**2) ** (-sp.Rational(1, 2)), -(x**2), (-x) ** 2, sp.re(x) + sp.conjugate(x), x**2.5 / x**0.5,
    sp.sinh(x) * sp.tanh(y), 1 / (1 + 1 / (3 + 1 / x)), sp.real_root(x, 3), sp.log(x**2, 2),
    sp.loggamma(x + 2), sp.erfc(x), x * sp.frac(y / 3), sp.GoldenRatio * x - sp.Catalan, 1 / x + (x + y) ** -2,
    Sqrt(sp.cosh(y)), sp.Piecewise((x, sp.Eq(x, y)), (y, sp.Ne(x, 1)), (k, True)), sp.Max(x, y, k, l), log1p(x**2),
]  # fmt: skip
STATES = [(0.75, 1.625), (1.875, -0.625), (-0.6875, 0.5)]


def test_functions():
    """Values and slopes of all supported functions equal SymPy's, on all sides of their branches."""
    params = {"k": 1.25, "l": 0.75}
    system = lj.from_sympy(KINETIC, [x, y], [m, k, l], constraints={"all": EXPRESSIONS})
    of_all: Any = system.constraints["all"]
    residual = lambda q: of_all.g(0.0, {"x": q[0], "y": q[1]}, params)
    values, slopes = map(
        np.asarray, jax.jit(jax.vmap(lambda q: (residual(q), jax.jacrev(residual)(q))))(jnp.array(STATES))
    )
    a, b = sp.symbols("a b", real=True)
    constants = {k: sp.Rational(5, 4), l: sp.Rational(3, 4)}
    of = sp.lambdify((a, b), [e.doit().subs(constants).subs({x: a, y: b}) for e in EXPRESSIONS], "mpmath")
    with mpmath.workdps(40):
        for place, (p, q) in enumerate(STATES):
            step = mpmath.mpf(10) ** -12
            for i, expected in enumerate(of(mpmath.mpf(p), mpmath.mpf(q))):
                if mpmath.im(expected):
                    # SymPy's roots and logarithms of negative numbers are complex, ours are NaN.
                    assert np.isnan(values[place, i]), EXPRESSIONS[i]
                    continue
                close = {"rtol": 1e-12, "atol": 1e-12, "err_msg": str(EXPRESSIONS[i])}
                np.testing.assert_allclose(values[place, i], float(mpmath.re(expected)), **close)
                moved = [(of(p + s * step, q)[i], of(p, q + s * step)[i]) for s in (1, -1)]
                expected = [float(mpmath.re(plus - minus) / (2 * step)) for plus, minus in zip(*moved)]
                np.testing.assert_allclose(slopes[place, i], expected, **close)


def test_a_branch_that_is_not_taken_harms_nobody():
    """Where a root is not taken the slope is zero; twin: without the harmless argument it is NaN."""
    ours: Any = lj.from_sympy(HERTZ, [x], [k]).lagrangian
    of_x = lambda function: lambda x: function(0.0, {"x": x}, {"x": 0.0}, {"k": 1.0})
    slope = lambda function, value: by_numpy(jax.grad(of_x(function)))(value)
    assert slope(ours, -0.5) == 0.0 and slope(ours, 4.0) == 2.5 * 4.0**1.5
    harmless = "jnp.where(jnp.greater_equal(x, 0), x, 0.5)"
    assert harmless in ours.source
    assert np.isnan(slope(dataclasses.replace(ours, source=ours.source.replace(harmless, "x")), -0.5))


def test_what_jumps_is_chosen_by_a_comparison():
    """A program of `where`s and whole powers; twin: SymPy's own for JAX, of the same values, is one of an index, with
    powers of floats."""
    a, b = sp.symbols("a b")
    written = sp.Piecewise((a, sp.And(a > 0, b > 0)), (sp.Max(a, b, 2) ** -3, a < -1), (10**12 * a, True))
    of_all: Any = lj.from_sympy(KINETIC, [x, y], [m], constraints={"one": written.subs({a: x, b: y})}).constraints
    ours = lambda x, y: of_all["one"].function(0.0, {"x": x, "y": y}, {})
    theirs = sp.lambdify((a, b), written, "jax")
    programs = [str(jax.make_jaxpr(function)(2.0, 1.0)) for function in (ours, theirs)]
    assert ["argmax" in program for program in programs] == [False, True]
    assert ["integer_pow[y=-3]" in program for program in programs] == [True, False]
    for state in (*STATES, (-2.0, 3.0)):
        np.testing.assert_allclose(ours(*state), theirs(*state), rtol=1e-15)
    assert "1000000000000.0*x" in str(of_all["one"].function)


def test_copies_and_words():
    """A system prints its expression and source, and equals its copies and another one of the same source."""
    make = lambda: lj.from_sympy(KINETIC - POTENTIAL, [x, y], [m, g, l], constraints={"rod": sp.Eq(x**2 + y**2, l**2)})
    system = make()
    assert repr(system) == "System(-g*m*y + m*(x'**2 + y'**2)/2; constraints: rod (holonomic))"
    assert str(system.lagrangian).splitlines()[0] == "def function(t, q, v, params):"
    for same in (make(), copy.deepcopy(system), pickle.loads(pickle.dumps(system))):
        assert same == system and str(same.lagrangian) == str(system.lagrangian)
    other = lj.from_sympy(KINETIC + POTENTIAL, [x, y], [m, g, l])
    assert other.lagrangian != system.lagrangian


def test_without_sympy(monkeypatch):
    """A pickled system runs without SymPy; `from_sympy` says how to install it."""
    pickled = pickle.dumps(lj.from_sympy(KINETIC - POTENTIAL, [x, y], [m, g]))
    for name in [name for name in sys.modules if name.split(".")[0] == "sympy"]:
        monkeypatch.setitem(sys.modules, name, None)
    at = {"x": 1.0, "y": 2.0}
    assert float(pickle.loads(pickled).lagrangian(0.0, at, at, {"m": 2.0, "g": 3.0})) == 5.0 - 12.0
    with pytest.raises(ImportError, match='pip install "lagjax.sympy."'):
        lj.from_sympy(KINETIC, [x, y], [m])


L = KINETIC - POTENTIAL
REFUSED = {
    "an unknown symbol": (lambda: lj.from_sympy(L, [x, y], [m]), "(?s)'g', which is unknown.*parameters=.m, g."),
    "another of its name": (lambda: lj.from_sympy(L, [x, y], [m, sp.Symbol("g")]), "a symbol 'g' that is not the same"),
    "a symbol named as a coordinate": (lambda: lj.from_sympy(L + sp.Symbol("y"), [x, y], [m, g]), "a coordinate, 'y'"),
    "another time": (lambda: lj.from_sympy(L + sp.Symbol("t", real=True), [x, y], [m, g]), "as the time of"),
    "an acceleration": (lambda: lj.from_sympy(L + x.diff(t, 2), [x, y], [m, g]), "an acceleration"),
    "a coordinate left out": (lambda: lj.from_sympy(L, [x], [m, g]), "Fix: coordinates=.x, y."),
    "one name for two": (lambda: lj.from_sympy(L, [x, y], [m, g, sp.Symbol("x")]), "have the name 'x'"),
    "a coordinate twice": (lambda: lj.from_sympy(L, [x, y, x], [m, g]), "have the name 'x'"),
    "the time": (lambda: lj.from_sympy(L, [x, y], [m, g, t]), "is the time"),
    "a matrix": (lambda: lj.from_sympy(sp.Matrix([L]), [x, y], [m, g]), "L.0. of a matrix"),
    "text": (lambda: lj.from_sympy("m", [x, y], [m, g]), "SymPy expression, not 'm'"),
    "no formula": (lambda: lj.from_sympy(L + sp.Function("V")(x), [x, y], [m, g]), "'V' is in L, but has no"),
    "nor this, of a known name": (lambda: lj.from_sympy(L + sp.Function("gamma")(x), [x, y], [m, g]), "'gamma' is in"),
    "a function of SymPy alone": (lambda: lj.from_sympy(L + sp.besselj(0, x), [x, y], [m, g]), "'besselj' is in L"),
    "one of Python's alone": (lambda: lj.from_sympy(L + sp.factorial(x), [x, y], [m, g]), "'factorial' is in L"),
    "a complex number": (lambda: lj.from_sympy(L + sp.I * x, [x, y], [m, g]), "'I' is in L"),
    "symbols as coordinates": (lambda: lj.from_sympy(L, sp.symbols("x y"), [m, g]), "a coordinate is a function"),
    "velocities as coordinates": (lambda: lj.from_sympy(L, [x, x.diff()], [m, g]), "is a velocity"),
    "no list": (lambda: lj.from_sympy(L, x, [m, g]), "coordinates must be a list"),
    "numbers": (lambda: lj.from_sympy(L, [x, y], {m: 1.0}), "numbers are passed to lj.integrate"),
    "no coordinates": (lambda: lj.from_sympy(L), "coordinates of the Lagrangian are missing"),
    "coordinates of a method": (lambda: lj.from_sympy(me.LagrangesMethod(L, [x, y]), [x]), "has its own coordinates"),
    "a truth": (lambda: lj.from_sympy(L, [x, y], [m, g], constraints={"rod": x == y}), "constraint 'rod' must be"),
    "no condition": (lambda: lj.from_sympy(L, [x, y], [m, g], constraints={"rod": m - g}), "contains no coordinate"),
    "a force on nothing": (lambda: lj.from_sympy(L, [x, y], [m, g], force={"x": 1}), "a component for 'x', but the"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    """The error names the user's symbols and gives a fix."""
    ask, words = REFUSED[case]
    with pytest.raises((TypeError, ValueError), match=words):
        ask()


TS = np.linspace(0.0, 1.0, 5)
# Reads each program and the arguments of its calls, runs them, and writes the results.
ELSEWHERE = textwrap.dedent("""
    import json, pathlib, sys
    import jax, numpy as np
    from jax import export
    jax.config.update("jax_enable_x64", True)
    folder = pathlib.Path(sys.argv[1])
    for name, calls in json.loads((folder / "calls.json").read_text()).items():
        program = export.deserialize(bytearray((folder / name).read_bytes()))
        as_floats = lambda tree: jax.tree.map(lambda x: np.asarray(x, float), tree, is_leaf=lambda x: type(x) is list)
        for i, arguments in enumerate(calls):
            leaves = jax.tree.leaves(program.call(*(as_floats(x) for x in arguments)))
            np.savez(folder / f"{name}-{i}.npz", *leaves)
    mine = {"lagjax", "diffrax", "equinox", "lineax", "optimistix"} & {name.split(".")[0] for name in sys.modules}
    assert not mine, mine
""")


def swing(angle, speed, params, **options):
    """The pendulum by its angle."""
    return lj.integrate(pendulum, angle, speed, params, ts=TS, **options)


def slope(angle, params):
    """The last angle and its derivatives with respect to all arguments."""
    return jax.value_and_grad(lambda angle, params: swing(angle, 0.5, params).q[-1], (0, 1))(angle, params)


def by_jax_alone(angle, params):
    """Exportable by `jax.export` itself: no exceptions, and only arrays are returned."""
    motion = swing(angle, 0.0, params, throw=False)
    return motion.q, motion.v


OTHER = PARAMS | {"g": 9.0}
LOW = {"low": lj.Crossing(lambda t, q, v, params: q)}
# The function and two calls of it.
CASES = {
    "rod": (
        lambda q, v, params: lj.integrate(rod_pendulum, q, v, params, ts=TS),
        (*HORIZONTAL, PARAMS),
        ({"x": 0.75, "y": -1.0}, HORIZONTAL[1], PARAMS),
    ),
    "event": (lambda *state: swing(*state, events=LOW), (1.0, 0.0, PARAMS), (0.5, 0.5, OTHER)),
    "slope": (slope, (1.0, PARAMS), (1.0, OTHER)),
}


def written(folder, name, exported, *calls):
    """Write a program and the arguments of its calls; returns the size of its file."""
    (folder / name).write_bytes(exported.serialize())
    listed = jax.tree.map(lambda x: np.asarray(x).tolist(), calls)
    known = json.loads((folder / "calls.json").read_text()) if (folder / "calls.json").exists() else {}
    (folder / "calls.json").write_text(json.dumps(known | {name: listed}))
    return (folder / name).stat().st_size


def read(folder, name, call):
    """The results of the other process."""
    with np.load(folder / f"{name}-{call}.npz") as file:
        return [file[f"arr_{i}"] for i in range(len(file.files))]


@pytest.mark.optimised
@pytest.mark.exhaustive
def test_another_process_without_lagjax(tmp_path):
    """Motions, forces, events and derivatives equal those here bit for bit; twin: other arguments change them."""
    for name, (run, *calls) in CASES.items():
        assert written(tmp_path, name, lj.export(run, *calls[0]), *calls) < 150_000
    jitted = jax.jit(by_jax_alone)
    assert written(tmp_path, "jax", export.export(jitted)(1.0, PARAMS), (1.0, PARAMS)) < 100_000
    # A batch of any size uses other kernels than a single motion, with another round-off.
    (size,) = export.symbolic_shape("size")
    many, batch = jax.ShapeDtypeStruct((size,), np.float64), jax.vmap(swing, (0, None, None))
    angles = np.linspace(0.5, 1.5, 300)
    written(tmp_path, "batch", lj.export(batch, many, 0.0, PARAMS), (angles[:3], 0.0, PARAMS), (angles, 0.0, PARAMS))
    subprocess.run([sys.executable, "-c", ELSEWHERE, str(tmp_path)], check=True, cwd=tmp_path, timeout=300)
    for name, (run, *calls) in CASES.items():
        here = [jax.tree.leaves(plain(jax.jit(run)(*call))) for call in calls]
        for call, expected in enumerate(here):
            found = read(tmp_path, name, call)
            assert len(found) == len(expected)
            for x, y in zip(found, expected):
                np.testing.assert_array_equal(x, y)
        assert any(not np.array_equal(x, y, equal_nan=True) for x, y in zip(*here))
    for x, y in zip(read(tmp_path, "jax", 0), jitted(1.0, PARAMS)):
        np.testing.assert_array_equal(x, y)
    every = plain(jax.jit(batch)(angles, 0.0, PARAMS))
    for call, start in enumerate((angles[:3], angles)):
        expected = jax.tree.map(lambda x: x[: len(start)], every)
        found = jax.tree.unflatten(jax.tree.structure(expected), read(tmp_path, "batch", call))
        np.testing.assert_allclose(found["q"], expected["q"], atol=1e-12)
        assert found["q"].shape == (len(start), len(TS)) and not found["result"].any()


@pytest.mark.exhaustive
def test_derivatives_of_what_was_written():
    """With `vjp_order=1` the derivative is exported as well, and equals that of the motion here."""
    exported = lj.export(lambda angle, params: swing(angle, 0.5, params).q[-1], 1.0, PARAMS)
    read_again = export.deserialize(exported.serialize(vjp_order=1))
    found = jax.grad(lambda *x: read_again.call(*x), (0, 1))(1.0, PARAMS)
    _, expected = slope(1.0, PARAMS)
    for x, y in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        np.testing.assert_allclose(x, y, rtol=1e-12)


def test_a_motion_is_a_dictionary():
    """Whatever a trajectory has is an array by name, its result a code; a failing check gives NaN."""
    traj = motion("pendulum")
    codes = lj.RESULTS.successful._value, lj.RESULTS.max_steps_reached._value

    def run(angle):
        new = angle * traj.q, jnp.where(angle > 1.5, codes[1], codes[0])
        return eqx.tree_at(lambda x: (x.q, x.result._value), traj, new), eqx.error_if(angle, angle > 2, "too far")

    exported = lj.export(run, 1.0)
    for angle, code, words in ((1.0, codes[0], "successful"), (1.75, codes[1], "The maximum number of solver steps")):
        found, checked = exported.call(angle)
        np.testing.assert_array_equal(found["q"], angle * np.asarray(traj.q))
        np.testing.assert_array_equal(found["t"], traj.t)
        assert found["result"] == code and checked == angle and lj.result_codes()[int(code)].startswith(words)
    assert np.isnan(exported.call(3.0)[1])


@pytest.mark.slow
def test_failures_are_codes():
    """A motion that would raise gives a code instead and keeps its first outputs; a failing check gives NaN."""

    def run(angle, params):
        return swing(angle, 0.0, params, max_steps=5), eqx.error_if(angle, angle > 2, "too far")

    exported = lj.export(run, 1.0, PARAMS)
    motion, checked = exported.call(1.0, PARAMS)
    assert lj.result_codes()[int(motion["result"])].startswith("The maximum number of solver steps was reached")
    assert motion["q"][0] == 1.0 and np.isfinite(motion["q"][1]) and np.isnan(motion["q"][-1]) and checked == 1.0
    assert np.isnan(exported.call(3.0, PARAMS)[1])


def test_without_its_extra(monkeypatch):
    """Without flatbuffers, which JAX misses when all has been compiled, nothing is called."""
    called = []
    monkeypatch.setitem(sys.modules, "flatbuffers", None)
    with pytest.raises(ImportError, match="pip install .lagjax.export.."):
        lj.export(called.append, 1.0)
    assert called == []


def test_result_codes():
    """Each item of `lj.RESULTS` has a description."""
    codes = lj.result_codes()
    assert codes[int(lj.RESULTS.start_off_constraints._value)] == "The initial state does not satisfy the constraints."
    assert codes[int(lj.RESULTS.event_occurred._value)] == "ended by its event" and len(codes) == len(lj.RESULTS)


def prints(x):
    """A function that calls Python."""
    jax.debug.print("{}", x)
    return x


NOT_EXPORTED = {
    "no function": (lambda: lj.export(motion("pendulum")), "must be a function of .* not a Trajectory"),
    "a class": (lambda: lj.export(lambda x: x, lj.RESULTS.successful), "an argument of an exported program"),
    "a system": (lambda: lj.export(lambda system, x: x, pendulum, 1.0), "and not System"),
    "text": (lambda: lj.export(lambda x: x, {"a": "text"}), "and not str"),
    "text back": (lambda: lj.export(lambda x: {"a": "text"}, 1.0), "returned 'text', a str"),
    "any number of times": (
        lambda: lj.export(
            lambda ts: lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=ts),
            jax.ShapeDtypeStruct(export.symbolic_shape("n"), np.float64),
        ),
        "number of output times must be known .* is n",
    ),
    "a print": (lambda: lj.export(prints, 1.0), "calls Python while it runs"),
    "a callback": (
        lambda: lj.export(lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), np.float64), x), 1.0),
        "calls Python while it runs",
    ),
}


@pytest.mark.parametrize("case", NOT_EXPORTED)
def test_what_is_not_exported(case):
    """The error says what is refused."""
    ask, words = NOT_EXPORTED[case]
    with pytest.raises((TypeError, ValueError), match=words):
        ask()


def test_whole_numbers_and_structures():
    """Python integers become floats in the program; lists, tuples, None and integer arrays stay the same."""
    exported = lj.export(lambda a, b: (a["x"] + b[0], [b[1], None]), {"x": 1}, (2, np.arange(3)))
    found, (whole, nothing) = exported.call({"x": 0.5}, (0.25, np.array([4, 5, 6])))
    assert found == 0.75 and whole.dtype == jnp.int64 and nothing is None


class Layer(eqx.Module):
    """A network of one layer."""

    weights: np.ndarray
    activation: Callable

    def __call__(self, x):
        return jnp.sum(self.activation(self.weights * x))


def test_weights_are_arguments():
    """A network among the arguments is a list of arrays there: other weights give what they give here; twin: others."""
    first, other = (Layer(np.array(weights), jnp.tanh) for weights in ([0.5, -0.25], [1.0, 2.0]))

    def run(x, params):
        return {"y": params["net"](x) + params["k"]}

    program = lj.export(run, np.ones(2), {"net": first, "k": 1.0})
    arrays = {"net": jax.tree.leaves(eqx.filter(other, eqx.is_array)), "k": 2.0}
    found = export.deserialize(bytearray(program.serialize())).call(0.5 * np.ones(2), arrays)["y"]
    of = lambda net: np.sum(np.tanh(0.5 * net.weights)) + 2.0
    assert np.isclose(found, of(other)) and not np.isclose(found, of(first))
    with pytest.raises(TypeError, match="must be a number or an array"):
        lj.export(run, np.ones(2), {"net": eqx.nn.Identity(), "k": 1.0})
