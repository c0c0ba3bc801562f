"""Import and export: a `System` from a Lagrangian derived with SymPy, compiled programs for processes without lagjax.

*From SymPy.* A coordinate is a function of time, `dynamicsymbols("theta")` or `Function("theta")(t)`; its velocity is
its `.diff(t)`, and every other symbol is a parameter. SymPy's equations are not used: the expressions become a function
`L(t, q, v, params)`, and lagjax derives the motion as from any other Lagrangian.

SymPy uses two signs of multipliers. In the equations of its `LagrangesMethod` and from `solve_multipliers` they push
along -∂g/∂q; the last unknowns of `mass_matrix_full` and `rhs()` push along +∂g/∂q, like all multipliers here.

An expression becomes the source text of a JAX function, by SymPy's own printer for JAX. A `System` from SymPy contains
this text: it can be read, compared, copied and pickled, and Python compiles it at its first call. Common subexpressions
are computed once. Integer powers stay integers: JAX computes them, and their derivatives, by products.

A `Piecewise` becomes `jnp.where`, which computes every branch. JAX's reverse mode multiplies the slope of a branch that
is not taken by zero, and zero times an infinite slope or NaN is NaN: for example (-x)**1.5 for x < 0, 0 for x > 0.
So functions without a slope at some numbers (roots, fractions, logarithms, inverse functions) get a harmless argument
in branches that are not taken.

*Without lagjax.* JAX compiles the function to a StableHLO program, which does not need the Python code that made it;
`jax.export` writes such programs to bytes. Three parts of a motion prevent this, and are removed here:

- checks that raise an error at run time, for which the program calls Python: failures become codes and NaN instead;
- a `Trajectory`, whose class the other process does not have: it becomes a dictionary of its arrays;
- prints, callbacks and progress meters: these are refused.
"""

import keyword
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import reduce
from importlib import import_module
from itertools import count
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import export as jax_export
from jaxtyping import PyTree

from lagjax.contexts import SILENT
from lagjax.integrate import RESULTS, Trajectory
from lagjax.integrate import in_words as result_in_words
from lagjax.jaxtools import calls_host, jaxpr_as_fun, once, poisoned
from lagjax.mechanics import listed
from lagjax.refusals import installed, must, must_be, must_be_function, must_not_meet
from lagjax.system import OF_POSITION, OF_STATE, Holonomic, Nonholonomic, System

# JAX's functions by SymPy's names, where SymPy's printer for JAX has none.
FUNCTIONS = {
    **{name: f"jax.scipy.special.{name}" for name in ("erf", "erfc", "gamma")},
    **{"loggamma": "jax.scipy.special.gammaln", "Abs": "jnp.abs", "Heaviside": "jnp.heaviside"},
}  # fmt: skip
# Functions without a value or a slope at some numbers, but with both at one half.
DELICATE = ("log", "asin", "acos", "atanh", "log2", "log10", "log1p", "Sqrt", "gamma", "loggamma")
# JaxPrinter reduces arrays of these, in one version otherwise than in another.
PAIRWISE = {"And": "jnp.logical_and({}, {})", "Or": "jnp.logical_or({}, {})",
            "Max": "jnp.maximum({}, {})", "Min": "jnp.minimum({}, {})"}  # fmt: skip
# Larger integers are written as floats, since JAX's integers may have 32 bits.
WHOLE = 2**31 - 1
RESERVED = {"t", "q", "v", "params", "jax", "jnp", "multipliers"}


def sympy_itself(user: str = "lj.from_sympy") -> Any:
    """Import SymPy, or say how to get it; `user` is the function that needs it."""
    return installed("sympy", user, "sympy")


class NotInJax(Exception):
    """A part of a SymPy expression has no counterpart in JAX."""


class SymPyFunction(eqx.Module):
    """A function made from a SymPy expression. It is compared by its text, and can be copied and pickled.

    - `source`: its text, which `print` shows; `written`: the expression as SymPy prints it.
    """

    source: str = eqx.field(static=True)
    written: str = eqx.field(static=True)
    takes: tuple[str, ...] = eqx.field(static=True)

    @property
    def __name__(self):
        return self.written if len(self.written) <= 80 else f"{self.written[:76]} ..."

    def __call__(self, *state):
        return _compiled(self.source)(*state)

    def __str__(self):
        return self.source

    def __repr__(self):
        return f"SymPyFunction({self.__name__})"


@once
def _compiled(source):
    """Compile the function of a source text, under the file name that tracebacks show."""
    found: dict[str, Any] = {"jax": jax, "jnp": jnp}
    exec(compile(source, "<from SymPy>", "exec"), found)
    return found["function"]


def function_of(takes: Sequence[str], result: Any, written: str, names: Mapping[Any, tuple[str, str]]) -> SymPyFunction:
    """The function that computes an expression, or a list or a dictionary of them.

    `names`: the argument and key of each symbol in the expressions: ("params", "m") is params["m"], ("t", "") the time.
    """
    sympy = sympy_itself()
    taken, symbols = set(RESERVED), {}
    for part, (argument, key) in names.items():
        name = _identifier(key + "_dot" * (argument == "v"), taken) if key else argument
        # Real, so that SymPy adds no complex conjugates.
        symbols[part] = sympy.Symbol(name, real=True)
    given = list(result.values()) if isinstance(result, dict) else result if isinstance(result, list) else [result]
    given = [_guarded(_in_jax(expression.xreplace(symbols)), sympy.true) for expression in given]
    used = set().union(*(expression.free_symbols for expression in given))
    fresh = (sympy.Symbol(name, real=True) for name in map("c{}".format, count()) if name not in taken)
    common, given = sympy.cse(given, fresh, list=True)
    write = _printer().doprint
    values = [repr(float(e)) if e.is_number else write(e) for e in given]
    if isinstance(result, dict):
        returned = f"{{{', '.join(f'{key!r}: {value}' for key, value in zip(result, values))}}}"
    else:
        returned = f"jnp.stack([{', '.join(values)}])" if isinstance(result, list) else values[0]
    lines = [
        f"{symbols[x]} = {argument}[{key!r}]" for x, (argument, key) in names.items() if key and symbols[x] in used
    ]
    lines += [f"{name} = {write(e)}" for name, e in common] + [f"return {returned}"]
    body = "".join(f"    {line}\n" for line in lines)
    return SymPyFunction(f"def function({', '.join(takes)}):\n{body}", written, tuple(takes))


def _identifier(key, taken):
    name = re.sub(r"\W+", "_", key).strip("_") or "x"
    name = f"x{name}" if name[0].isdigit() else name
    while name in taken or keyword.iskeyword(name):
        name += "_"
    taken.add(name)
    return name


def _guarded(expression, where):
    """The expression in which `DELICATE` functions of a branch get the argument 1/2 if the branch is not taken.

    `where`: the condition under which this part of the expression is taken.
    """
    sympy = sympy_itself()
    if isinstance(expression, sympy.Piecewise):
        before, branches = sympy.false, []
        for branch, condition in expression.args:
            taken = sympy.And(where, condition, sympy.Not(before))
            branches.append((_guarded(branch, taken), condition))
            before = sympy.Or(before, condition)
        return sympy.Piecewise(*branches, evaluate=False)
    if not expression.args or where == sympy.true and not expression.has(sympy.Piecewise):
        return expression
    args = [_guarded(arg, where) for arg in expression.args]
    is_power = expression.is_Pow and not (expression.exp.is_Integer and expression.exp > 0)
    if where != sympy.true and (is_power or expression.func.__name__ in DELICATE) and args[0].free_symbols:
        # Not a `Piecewise`, which SymPy would pull out of a power.
        args[0] = sympy.Function("harmless", real=True)(args[0], where)
    return expression.func(*args)


def _in_jax(expression):
    """The expression in functions that JAX has; raises `NotInJax` for others."""
    sympy = sympy_itself()
    one = sympy.Integer(1)
    others = {
        sympy.sec: lambda x: one / sympy.cos(x),
        sympy.csc: lambda x: one / sympy.sin(x),
        sympy.cot: lambda x: sympy.cos(x) / sympy.sin(x),
        sympy.sech: lambda x: one / sympy.cosh(x),
        sympy.csch: lambda x: one / sympy.sinh(x),
        sympy.coth: lambda x: sympy.cosh(x) / sympy.sinh(x),
    }
    for function, instead in others.items():
        expression = expression.replace(function, instead)
    kinds = [sympy.Add, sympy.Mul, sympy.Pow, sympy.Symbol, sympy.Number, sympy.NumberSymbol]
    kinds += [sympy.Piecewise, sympy.functions.elementary.piecewise.ExprCondPair, sympy.ITE, sympy.Max, sympy.Min]
    kinds += [sympy.sinc, sympy.frac, sympy.Mod]
    kinds += [sympy.And, sympy.Or, sympy.Not, sympy.core.relational.Relational, sympy.logic.boolalg.BooleanAtom]
    for part in sympy.preorder_traversal(expression):
        # SymPy counts `nan` and `zoo` as numbers.
        known = isinstance(part, tuple(kinds)) and part not in (sympy.nan, sympy.zoo)
        undefined = isinstance(part, sympy.core.function.AppliedUndef)
        if not known and (undefined or type(part).__name__ not in type(_printer())._kf):
            raise NotInJax(type(part).__name__ if part.args and not part.is_Atom else str(part))
    return expression


@once
def _printer() -> Any:
    """SymPy's printer for JAX, but for what would lose digits, 32 bits, or the comparisons that lagjax looks for."""
    from sympy.printing.numpy import JaxPrinter

    sympy = sympy_itself()

    class Printer(JaxPrinter):
        _kf = JaxPrinter._kf | FUNCTIONS

        def _module_format(self, fqn, register=True):
            return fqn.replace("jax.numpy", "jnp")

        def _print_Integer(self, expr):
            return repr(int(expr)) if abs(expr) <= WHOLE else repr(float(expr))

        def _print_Float(self, expr):
            return repr(float(expr))

        def _print_Pow(self, expr, rational=False):
            # JaxPrinter makes negative integer powers powers of floats.
            return self._hprint_Pow(expr, rational=rational, sqrt="jnp.sqrt")

        def _print_Piecewise(self, expr):
            # In JaxPrinter's `jnp.select` no comparison chooses between two values: jumps would not be found.
            (value, condition), *others = expr.args
            if condition == sympy.true:
                return self._print(value)
            # If no condition holds, the value is undefined.
            other = self._print(expr.func(*others, evaluate=False)) if others else "jnp.nan"
            return f"jnp.where({self._print(condition)}, {self._print(value)}, {other})"

        def _print_AppliedUndef(self, expr):
            # The only undefined function left is `harmless`.
            argument, where = map(self._print, expr.args)
            return f"jnp.where({where}, {argument}, 0.5)"

    for name, of_two in PAIRWISE.items():
        setattr(Printer, f"_print_{name}", lambda self, e, text=of_two: reduce(text.format, map(self._print, e.args)))
    return Printer()


def from_sympy(
    lagrangian: Any,
    coordinates: Sequence | None = None,
    parameters: Sequence = (),
    *,
    constraints: Mapping[str, Any] | Sequence | None = None,
    force: Mapping[Any, Any] | None = None,
    dissipation: Any = None,
) -> System:
    """Make a system from a Lagrangian that is a SymPy expression.

    >>> import lagjax as lj
    >>> from sympy import cos, symbols
    >>> from sympy.physics.mechanics import dynamicsymbols
    >>> theta, (m, l, g) = dynamicsymbols("theta"), symbols("m l g")
    >>> L = m * l**2 * theta.diff() ** 2 / 2 + m * g * l * cos(theta)
    >>> pendulum = lj.from_sympy(L, [theta], [m, l, g])
    >>> params = {"m": 1.0, "l": 2.0, "g": 9.8}
    >>> a, _ = lj.accelerations(pendulum, 0.0, {"theta": 0.5}, {"theta": 0.0}, params)
    >>> print(a["theta"].round(6))  # -g/l sin(1/2)
    -2.349185

    **Main arguments:**

    - `lagrangian`: L, `[energy]`, as an expression in coordinates, their first time derivatives, time and
      parameters; `sympy.physics.mechanics.Lagrangian(frame, *bodies)` gives one. Or a
      `sympy.physics.mechanics.LagrangesMethod`, with its coordinates, forces and constraints.
    - `coordinates`: functions of time, such as `dynamicsymbols("x y")`. Their names are keys of `q` and `v`: `q["x"]`.
    - `parameters`: symbols; their names are the keys of `params`.

    **Other arguments:**

    - `constraints`: expressions that vanish, or equations `Eq(a, b)`, by name: holonomic if they contain no velocity,
      nonholonomic otherwise. A list or a matrix under one name is a constraint of several equations. Without names they
      are "constraint1", "constraint2", ...; so are those of a `LagrangesMethod`, holonomic ones first, and their
      multipliers are minus its "lam1", "lam2", ...
    - `force`: generalized forces Q that L does not contain, `[L]/[q]`, by coordinate: `{x: -c * x.diff()}`.
    - `dissipation`: Rayleigh's function R; its force is `-∂R/∂v`.

    **Returns:** a `System`, whose functions contain their source: `print(system.lagrangian)`. It can be copied and
    pickled, and no longer needs SymPy. Each branch of a `Piecewise` must be smooth where it is taken.

    **Raises:**

    - `ImportError` without SymPy.
    - `TypeError` for arguments that are not expressions, or not single numbers.
    - `ValueError` for a symbol or a function of time that is neither a coordinate nor a parameter, duplicate names,
      second derivatives, a coordinate whose velocity is not in L, and functions that JAX does not have.

    Source: Goldstein, *Classical Mechanics*, Eq. (1.53), (2.26); SymPy, `sympy.physics.mechanics.LagrangesMethod`.
    """
    sympy = sympy_itself()
    import_module("sympy.physics.mechanics")
    if isinstance(lagrangian, sympy.physics.mechanics.LagrangesMethod):
        method, lagrangian = lagrangian, lagrangian._L[0]
        for word, value in (("coordinates", coordinates), ("constraints", constraints), ("force", force)):
            fix = "lj.from_sympy(method, parameters=[m, g]), or pass the parts of it separately"
            must_not_meet({"a LagrangesMethod": method, word: value}, f"the method has its own {word}", fix, TypeError)
        coordinates, constraints = list(method.q), _equations_of(method)
        force = _forces_of(method)
    if coordinates is None:
        raise TypeError(
            "the coordinates of the Lagrangian are missing.\n"
            'Fix: lj.from_sympy(L, [theta], [m, l, g]), with theta = dynamicsymbols("theta").'
        )
    known = _Names(sympy, _several(coordinates, "coordinates"), _several(parameters, "parameters"))
    return System(
        known.function("L", lagrangian),
        {name: known.constraint(name, value) for name, value in _by_name(constraints).items()},
        force=None if force is None else known.force(force),
        dissipation=None if dissipation is None else known.function("dissipation", dissipation),
    )


class _Names:
    """The coordinates and parameters of a Lagrangian, and functions of them made from SymPy expressions."""

    def __init__(self, sympy, coordinates, parameters):
        self.sympy, self.coordinates, self.parameters = sympy, coordinates, parameters
        for x in coordinates:
            _check_coordinate(sympy, x)
        for x in parameters:
            fix = 'm, g = symbols("m g"), and parameters=[m, g]'
            must_be(
                sympy.Symbol,
                x,
                "a parameter must be a symbol",
                fix,
                "a coordinate, a name or a number among the parameters",
            )
        times = {x.args[0] for x in coordinates}
        if len(times) > 1:
            raise ValueError(
                f"the coordinates are functions of different times: {_commas(coordinates)}.\n"
                'Usual cause: dynamicsymbols(...) together with Function("x")(t) for symbols("t", real=True).\n'
                "Fix: t = dynamicsymbols._t for all of them."
            )
        (self.time,) = times or {sympy.physics.mechanics.dynamicsymbols._t}
        self.keys = {x: x.func.__name__ for x in coordinates} | {x: x.name for x in parameters}
        if self.time in parameters:
            raise ValueError(
                f"'{self.time}' is among the parameters, but is the time.\n"
                "Fix: leave it out of the parameters: L may depend on the time without that."
            )
        for key in self.keys.values():
            same_name = [str(x) for x in (*coordinates, *parameters) if self.keys[x] == key]
            if len(same_name) > 1:
                raise ValueError(
                    f"two of the coordinates and parameters have the name '{key}': {_commas(same_name)}.\n"
                    "Usual cause: symbols(...) and dynamicsymbols(...) with the same name, or symbols of one name with "
                    "different assumptions.\n"
                    "Fix: create each of them once, with different names."
                )
        # Velocities come first, since a velocity contains the coordinate.
        self.places = {x.diff(self.time): ("v", self.keys[x]) for x in coordinates}
        self.places |= {x: ("q", self.keys[x]) for x in coordinates} | {self.time: ("t", "")}
        self.places |= {x: ("params", self.keys[x]) for x in parameters}

    def expression(self, given, role) -> Any:
        """The given expression, checked to be a scalar of known symbols."""
        sympy = self.sympy
        found: Any = None
        with suppress(sympy.SympifyError):
            found = None if isinstance(given, str) else sympy.sympify(given)
        if isinstance(found, sympy.Equality) and role.startswith("constraint"):
            found = found.lhs - found.rhs
        well = isinstance(found, sympy.Expr) and not getattr(found, "is_Matrix", False)
        cause = "a matrix with one entry, a vector, or x == y, which Python evaluates to False"
        fix = "L[0] of a matrix, a.dot(b) of vectors, and x - y or Eq(x, y) for a constraint"
        must(well, f"{role} must be a scalar SymPy expression", given, fix, cause, TypeError)
        if found.has(sympy.Derivative, sympy.Sum, sympy.Product):
            found = found.doit(integrals=False)
        self._check(found, role)
        return found

    def function(self, role, given, takes=OF_STATE) -> SymPyFunction:
        """The function that computes an expression, or a list or a dictionary of them."""
        if isinstance(given, dict):
            found = {key: self.expression(x, f"{role} on '{key}'") for key, x in given.items()}
            written = ", ".join(f"{key}: {x}" for key, x in found.items())
        elif isinstance(given, list):
            found = [self.expression(x, role) for x in given]
            written = f"[{_commas(found)}]"
        else:
            found = self.expression(given, role)
            written = str(found)
        try:
            return function_of(takes, found, _without_time(written, self.coordinates), self.places)
        except NotInJax as error:
            raise ValueError(
                f"'{error}' is in {role}, but has no counterpart in JAX.\n"
                "Usual cause: a function without a formula, an unevaluated integral, the imaginary unit I, a unit.\n"
                "Fix: L.subs(f(x), ...) with its formula; .doit(); .rewrite(...) in other functions."
            ) from None

    def constraint(self, name: str, given) -> Holonomic | Nonholonomic:
        """The constraint; holonomic if it contains no velocity."""
        several = isinstance(given, list | tuple) or getattr(given, "is_Matrix", False)
        given, role = [*given] if several else given, f"constraint '{name}'"
        equations = [self.expression(x, role) for x in (given if several else [given])]
        found = equations if several else equations[0]

        def has(parts: list) -> bool:
            return any(x.has(*parts) for x in equations)

        if self.coordinates and has([x.diff(self.time) for x in self.coordinates]):
            return Nonholonomic(self.function(role, found))
        if not has(self.coordinates):
            raise ValueError(
                f"{role} contains no coordinate: {found}.\n"
                "Usual cause: a condition between parameters, or an equation that is already solved.\n"
                "Fix: leave it out."
            )
        return Holonomic(self.function(role, found, OF_POSITION))

    def force(self, given) -> SymPyFunction:
        """The force, one component per coordinate."""
        must_be(Mapping, given, "force must be a dictionary by coordinate", "force={x: -c * x.diff()}")
        for x in given:
            if x not in self.coordinates:
                raise ValueError(
                    f"force has a component for {x!r}, but the coordinates are {_commas(self.coordinates)}.\n"
                    "Fix: the coordinates themselves as keys, force={x: -c * x.diff()}."
                )
        return self.function("force", {self.keys[x]: given.get(x, 0) for x in self.coordinates})

    def _check(self, expression, role):
        """Raise if the expression contains anything but coordinates, velocities, the time and parameters."""
        sympy, velocities = self.sympy, [x.diff(self.time) for x in self.coordinates]
        for derivative in expression.atoms(sympy.Derivative):
            if derivative.expr in self.coordinates and derivative not in velocities:
                raise ValueError(
                    f"{role} contains {derivative}: an acceleration, or another derivative than the velocity.\n"
                    "Usual cause: equations of motion in place of L, or dynamicsymbols(..., 2).\n"
                    "Fix: use only coordinates and velocities in L; a force must not contain accelerations either."
                )
        for f in sorted(expression.atoms(sympy.core.function.AppliedUndef) - {*self.coordinates}, key=str):
            if f.args == (self.time,):
                raise ValueError(
                    f"{role} contains {f}, a function of time that is not a coordinate.\n"
                    "Usual cause: a missing coordinate, a generalized speed u in place of q.diff(), or a prescribed "
                    "motion.\n"
                    f"Fix: coordinates=[{_commas(x.func for x in (*self.coordinates, f))}]; L.subs(u, q.diff()); "
                    "L.subs(f, sin(Omega * t)).doit() for a prescribed motion."
                )
        unknown = sorted(expression.free_symbols - {*self.parameters, self.time}, key=str)
        if unknown:
            raise ValueError(self._about(unknown, role))

    def _about(self, unknown, role):
        """The message about unknown symbols."""
        known = {self.time.name: "the time of the coordinates"}
        known |= {key: "a coordinate" if x in self.coordinates else "a parameter" for x, key in self.keys.items()}
        same_name = [x for x in unknown if x.name in known]
        if same_name:
            x = same_name[0]
            return (
                f"{role} contains a symbol '{x}' that is not the same as {known[x.name]}, '{x}'.\n"
                "Usual cause: it was created twice, by symbols(...) with other assumptions, or by symbols(...) and "
                "dynamicsymbols(...).\n"
                "Fix: create it once, and use it everywhere; for the time t = dynamicsymbols._t."
            )
        all_parameters = _commas([*self.parameters, *unknown])
        return (
            f"{role} contains {listed(unknown)}, which {'is' if len(unknown) == 1 else 'are'} unknown.\n"
            "Usual cause: a parameter that was not listed, or a coordinate that is not a function of time.\n"
            f"Fix: parameters=[{all_parameters}]; or make a coordinate by dynamicsymbols({str(unknown[0])!r})."
        )


def _check_coordinate(sympy, x):
    if isinstance(x, sympy.core.function.AppliedUndef) and len(x.args) == 1 and x.args[0].is_Symbol:
        return
    is_velocity = isinstance(x, sympy.Derivative)
    raise TypeError(
        f"a coordinate is a function of time, but {x} is {'a velocity' if is_velocity else f'a {type(x).__name__}'}.\n"
        "Usual cause: symbols(...) in place of dynamicsymbols(...), or velocities among the coordinates.\n"
        'Fix: theta = dynamicsymbols("theta"); its velocity is theta.diff().'
    )


def _several(given, role):
    """A sequence as a list."""
    if isinstance(given, Mapping | str) or not hasattr(given, "__iter__"):
        raise TypeError(
            f"{role} must be a list, not {given!s:.60}.\n"
            f"Fix: {role}=[...], even for one; numbers are passed to lj.integrate, as a dictionary by their names."
        )
    return list(given)


def _by_name(constraints):
    if constraints is None:
        return {}
    if isinstance(constraints, Mapping):
        return dict(constraints)
    return {f"constraint{i}": constraint for i, constraint in enumerate(_several(constraints, "constraints"), 1)}


def _equations_of(method):
    """The constraints of a `LagrangesMethod`: holonomic, then nonholonomic; `coneqs` has the former differentiated."""
    holonomic = list(method._hol_coneqs)
    return [*holonomic, *list(method.coneqs)[len(holonomic) :]] or None


def _forces_of(method):
    """The generalized forces of loads on points and frames: `Q = Σ ∂(velocity)/∂(q') · load`."""
    if not method.forcelist:
        return None
    frame, found = method.inertial, {}
    for x, velocity in zip(method.q, method.u):
        found[x] = 0
        for body, load in method.forcelist:
            motion = body.vel(frame) if hasattr(body, "vel") else body.ang_vel_in(frame)
            found[x] += motion.diff(velocity, frame).dot(load)
    return found


def _without_time(written, coordinates):
    """A short form of an expression: theta for theta(t), and theta' for its derivative."""
    for x in coordinates:
        time = x.args[0]
        written = written.replace(f"Derivative({x}, {time})", f"{x.func.__name__}'").replace(str(x), x.func.__name__)
    return written


def _commas(items):
    return ", ".join(map(str, items))


# The containers that a process without lagjax can pass and receive.
PLAIN = (dict, list, tuple)
# The type of items of equinox's enumerations.
ITEM = type(RESULTS.successful)


def export(run: Callable, *examples: PyTree, platforms: Sequence[str] | None = None) -> jax_export.Exported:
    """Export a function that integrates as a program that needs only JAX, not lagjax.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> ts = jnp.array([0.0, 0.2, 0.5])
    >>> program = lj.export(lambda v0, params: lj.integrate(fall, 0.0, v0, params, ts=ts), 3.0, {"g": 10.0})
    >>> motion = program.call(3.0, {"g": 10.0})
    >>> print(motion["q"].round(9), lj.result_codes()[int(motion["result"])])
    [0.   0.4  0.25] successful

    **Arguments:**

    - `run`: any function that `jax.jit` accepts; it may contain motions and their derivatives.
    - `examples`: example arguments, which give structures, shapes and dtypes: numbers, arrays, `jax.ShapeDtypeStruct`,
      in dictionaries, lists and tuples. All of them become arguments of the program; Python integers become floats. In
      place of a module of equinox, such as a network, the program takes the list of its arrays, of whatever values:
      `jax.tree.leaves(equinox.filter(net, equinox.is_array))`.
      Shapes may be symbolic (`jax.export.symbolic_shape`), for a batch of any size under `jax.vmap`; the number of
      output times may not.
    - `platforms`: such as `("cpu", "cuda")`; by default the platform that JAX uses here.

    **Returns:** a `jax.export.Exported`: `.serialize()` gives its bytes, and in another process
    `jax.export.deserialize(bytes).call(*arguments)` runs it. It takes the same arguments as `run` and returns the
    same results, with dictionaries of arrays in place of trajectories and other classes with named fields. It never
    raises: a motion that fails is NaN from there on, and its "result" gives the reason, a number that
    `lj.result_codes()` explains. A failing check (`equinox.error_if`) gives NaN.

    **Raises:** `TypeError` for arguments or results that are not numbers, arrays, dictionaries, lists and tuples;
    `ValueError` for functions that call Python while they run; `ImportError` without the extra `export`, with which JAX
    writes bytes.

    Source: https://docs.jax.dev/en/latest/export/export.html; `docs/taking-a-solve-elsewhere.md`.
    """
    fix = "lj.export(lambda params: lj.integrate(system, q0, v0, params, ts=ts), params)"
    must_be_function(run, "the first argument of lj.export", "its examples", fix)
    # JAX itself asks for it in `serialize`, when all has been compiled.
    installed("flatbuffers", "lj.export, whose programs JAX writes with it,", "export")
    given, places = jtu.tree_flatten(examples, is_leaf=lambda x: type(x) not in PLAIN)
    examples = jtu.tree_unflatten(places, map(_as_argument, given))

    def program(*args):
        leaves, structure = jtu.tree_flatten(args)
        structures = []

        def of_leaves(*leaves):
            taken = places.flatten_up_to(jtu.tree_unflatten(structure, leaves))
            results, tree = jtu.tree_flatten(plain(run(*jtu.tree_unflatten(places, map(_with_arrays, given, taken)))))
            structures.append(tree)
            return [_as_result(x) for x in results]

        with SILENT(True):
            silent = poisoned(jax.make_jaxpr(of_leaves)(*leaves))
        if calls_host(silent.jaxpr) or silent.effects:
            raise ValueError(
                "the function calls Python while it runs, which is impossible in a process without that Python code.\n"
                "Usual cause: jax.debug.print, jax.debug.callback, jax.pure_callback, or progress=True.\n"
                "Fix: leave it out of the exported function."
            )
        return jtu.tree_unflatten(structures[0], jaxpr_as_fun(silent)(*leaves))

    # The name that is shown in the other process.
    program.__name__ = getattr(run, "__name__", "run")
    return jax_export.export(jax.jit(program), platforms=platforms)(*examples)


def result_codes() -> dict[int, str]:
    """The meanings of the numbers that an exported program returns as the "result" of a motion.

    >>> import lagjax as lj
    >>> lj.result_codes()[0]
    'successful'

    **Returns:** sentences by code, for this version of lagjax: store them together with the program.

    **Raises:** nothing.
    """
    return {code: result_in_words(code) for code in range(len(RESULTS))}


def plain(tree: PyTree) -> PyTree:
    """Convert to dictionaries, lists and tuples: classes become dictionaries, a `RESULTS` item its code."""
    if isinstance(tree, ITEM):
        return tree._value
    if isinstance(tree, Mapping):
        return {name: plain(x) for name, x in tree.items()}
    if hasattr(tree, "_fields"):
        return {name: plain(x) for name, x in zip(tree._fields, tree)}
    if isinstance(tree, list | tuple):
        return type(tree)(map(plain, tree))
    if is_dataclass(tree) and not isinstance(tree, type):
        # The system and the parameters of a trajectory (`arrays`) are inputs, not results.
        names = [f.name for f in fields(tree) if not f.metadata.get("static", False)]
        names = [name for name in names if not (isinstance(tree, Trajectory) and name == "arrays")]
        return {name: plain(getattr(tree, name)) for name in names}
    return tree


def _as_argument(x):
    """An example converted to the type that the program takes."""
    if isinstance(x, int) and not isinstance(x, bool):
        return float(x)
    if isinstance(x, bool | float | complex | np.ndarray | np.generic | jax.Array | jax.ShapeDtypeStruct):
        return x
    if (
        isinstance(x, eqx.Module)
        and not isinstance(x, ITEM)
        and (arrays := jtu.tree_leaves(eqx.filter(x, eqx.is_array)))
    ):
        return arrays
    raise TypeError(
        f"an argument of an exported program must be a number or an array, in dictionaries, lists and tuples, and not "
        f"{type(x).__name__}, which the other process does not know.\n"
        "Usual cause: a named tuple, a class, a system or a function among the examples.\n"
        'Fix: {"x": 1.0, "y": 0.0} in place of a class; close over everything else: lj.export(lambda q0: ..., q0).'
    )


def _with_arrays(example, argument):
    """An argument as the function takes it: a module with other arrays."""
    if not isinstance(example, eqx.Module):
        return argument
    arrays, rest = eqx.partition(example, eqx.is_array)
    return eqx.combine(jtu.tree_unflatten(jtu.tree_structure(arrays), argument), rest)


def _as_result(x):
    if isinstance(x, bool | int | float | complex | np.ndarray | np.generic | jax.Array):
        return jnp.asarray(x)
    raise TypeError(
        f"an exported program returns numbers and arrays, but the function returned {x!r:.60}, a {type(x).__name__}.\n"
        "Fix: return the parts that are needed, such as traj.q and traj.result."
    )
