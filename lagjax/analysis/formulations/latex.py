"""Lagrange's equations of a small system as formulas, read back from the program that computes them.

The program of M, F and A is expanded into scalar operations (`scalar_form.py`) and run on SymPy expressions in place of
numbers. The resulting formulas are then evaluated at random states and compared with the program.

Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (2.26), whose equations these are.
"""

import functools
import math
import re
from collections import defaultdict
from collections.abc import Callable
from fractions import Fraction
from importlib import import_module
from operator import add, mul, neg, sub, truediv
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import eval_jaxpr

from lagjax.exchange.from_sympy import sympy_itself
from lagjax.jaxtools.jaxpr import MOVING, interpreted
from lagjax.jaxtools.scalarize import MOVES, TooLong
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanics.scalar_form import Numbers, in_numbers
from lagjax.system import constraints, coordinates
from lagjax.system.argument_checks import check_system
from lagjax.system.check_functions import traced_system
from lagjax.system.model import model_of

# Beyond these numbers of operations, coordinates and terms the equations are too long to read.
OPERATIONS, COORDINATES, TERMS = 2000, 8, 400
# Fractions are written as such up to this denominator.
SMALL = 64
# Formulas that differ from the program by more than this are not shown.
AGREE = 1e-9
STATES = 16
# The primitives that have a formula: operations, and the names of SymPy's functions.
FORMULAS: dict[str, Callable | str] = {
    **{"add": add, "add_any": add, "sub": sub, "mul": mul, "div": truediv, "neg": neg, "pow": pow},
    **{"sqrt": lambda x: x ** Fraction(1, 2), "rsqrt": lambda x: x ** Fraction(-1, 2)},
    **{"cbrt": lambda x: x ** Fraction(1, 3), "square": lambda x: x**2, "abs": "Abs", "exp": "exp", "log": "log"},
    **{f"{a}{name}{h}": f"{a}{name}{h}" for name in ("sin", "cos", "tan") for a in ("", "a") for h in ("", "h")},
    "sign": "sign",
}


class EquationsOfMotion(eqx.Module):
    """Lagrange's equations `M a = F + Aᵀ λ` in LaTeX: a notebook displays them, `print` shows the source.

    - `lines`: one for each coordinate, and one for each constraint.
    - `error`: the largest relative difference of the formulas from the program at random states.
    """

    lines: tuple[str, ...] = eqx.field(static=True)
    error: float = eqx.field(static=True)
    states: int = eqx.field(static=True)

    def __str__(self):
        body = " \\\\\n".join(line.replace(" = ", " &= ", 1) for line in self.lines)
        return f"\\begin{{aligned}}\n{body}\n\\end{{aligned}}"

    def _repr_latex_(self):
        return f"$$\n{self}\n$$"

    def __repr__(self):
        return f"{self}\n(verified to {self.error:.0e} at {self.states} states)"


def latex(system, q, v, params=None, *, t=0.0) -> EquationsOfMotion:
    r"""Return Lagrange's equations of a small system in LaTeX, verified numerically.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def pendulum(t, q, v, params):
    ...     return 0.5 * params["m"] * (params["l"] * v["theta"]) ** 2 + params["m"] * params["g"] * jnp.cos(q["theta"])
    >>> params = {"m": 1.0, "l": 2.0, "g": 9.81}
    >>> print(lj.latex(lj.System(pendulum), {"theta": 0.1}, {"theta": 0.0}, params).lines[0])
    l^{2} m \ddot{\theta} = - g m \sin{\left(\theta \right)}

    **Arguments:** `q` and `v` of the same structure, `params` as the system takes it, `t` scalar: their names become
    the symbols; numbers inside the functions are written as numbers.

    **Returns:** an `EquationsOfMotion`: one equation per coordinate, `Σ M a = F + Aᵀ λ`, with multipliers λ named after
    their constraints, and each constraint `g = 0` or `phi = 0`. Products are expanded, sines and cosines combined where
    that is shorter.

    **Raises:**

    - `ImportError` without SymPy (extra `sympy`).
    - `ValueError` for a system that is not small, whose program has loops, branches or functions without a formula, or
      if the formulas do not agree with the program.
    - As `accelerations` for a state of the wrong kind.

    Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (2.26).
    """
    check_system(system, q, v, params)
    sympy_itself("lj.latex")
    s = coordinates.state(t, q, v, jax.tree.map(lambda x: float(x) if type(x) is int else x, params))
    try:
        system = traced_system(system, s)
    except (TypeError, IndexError):
        # An integer that is used as a count or an index must stay an integer.
        s = coordinates.state(t, q, v, params)
        system = traced_system(system, s)
    model = model_of(system, *s)
    names = model.names
    if len(names) > COORDINATES:
        raise ValueError(
            f"the system has {len(names)} coordinates, but equations are written only for up to {COORDINATES}."
        )
    scalarised = in_numbers(model)
    try:
        program = Numbers(_parts, scalarised, most=OPERATIONS).program
        symbols = _symbols(s)
        formulas = jaxpr_to_formula(program, _arrays(scalarised.system), _as_inputs(list(symbols), model.n))
    except TooLong:
        raise ValueError(
            "the equations are too long to be read.\n"
            "Usual cause: an L with sums over many parts, or a quadrature.\nFix: print a system with fewer parts."
        ) from None
    error = _verified(program, formulas, _as_inputs(list(symbols), model.n), scalarised, s)
    return EquationsOfMotion(tuple(_lines(names, model.equation_names, symbols, formulas)), error, STATES)


def _as_inputs(symbols: list, n: int) -> list:
    """The symbols of t, q, v and parameters in the order in which the program takes them: parameters first."""
    return symbols[1 + 2 * n :] + symbols[: 1 + 2 * n]


def _parts(model, t, q, v) -> list[jax.Array]:
    """The entries of M, F, A and the constraints; A includes the derivative of a force by the multipliers."""
    x, u = model.vectors(q, v)
    linear, rows = mass_and_forcing(model, t, x, u), constraints.jacobian(model, t, x, u)
    if linear.response is not None:
        rows = rows + linear.response.T
    held = [jnp.ravel(c.residual(t, q, v, model.params)) for c in model.system.constraints.values()]
    return [y for x in (linear.mass, linear.forcing, rows, *held) for y in jnp.ravel(x)]


def _arrays(tree) -> list[np.ndarray]:
    return [np.asarray(x) for x in jtu.tree_leaves(eqx.filter(tree, eqx.is_array))]


def _symbols(s: coordinates.State) -> dict[Any, str]:
    """The symbols of t, coordinates, velocities and parameters, in the order of the program's inputs, and their LaTeX.

    The first character of a symbol's own name is its place among the factors of a product, and keeps names apart.
    """
    sympy = sympy_itself()
    names, leaves = coordinates.names(s.q), eqx.filter(s.params, eqx.is_array)
    known = coordinates.names(leaves) if jtu.tree_leaves(leaves) else []
    if jtu.treedef_is_leaf(jtu.tree_structure(s.params)):
        known = [name.replace("q", "params", 1) for name in known]
    short = [name.split(".")[-1] for name in known]
    # Parameters with the same last name, such as the masses of two bodies, get the body as an index.
    letters = [x if short.count(x) == 1 else "_".join(reversed(name.split("."))) for x, name in zip(short, known)]
    entries = [("1", "t"), *((f"2{name}", written(name)) for name in names)]
    entries += [(f"3{name}", written(name, r"\dot")) for name in names]
    entries += [(f"0{name}", written(letter)) for name, letter in zip(known, letters)]
    return {sympy.Symbol(key, real=True): text for key, text in entries}


def written(name: str, accent: str = "") -> str:
    r"""A name in LaTeX: Greek letters, indices, and nothing but letters and digits.

    >>> written("theta"), written("m1", r"\dot"), written("r[0, 1]"), written("length")
    ('\\theta', '\\dot{m}_{1}', 'r_{0,1}', '\\mathrm{length}')
    """
    greek, translate = sympy_itself().core.alphabets.greeks, import_module("sympy.printing.latex").translate
    # Letters of any alphabet, and digits: no other character of a name reaches the formula.
    parts = re.findall(r"[^\W\d_]+|\d+", name)
    for i, part in enumerate(parts):
        if part.lower() in greek:
            parts[i] = translate(part)
        elif len(part) > 1 and not part.isdigit():
            parts[i] = rf"\mathrm{{{part}}}"
    first, *indices = parts or [r"\square"]
    return (f"{accent}{{{first}}}" if accent else first) + (f"_{{{','.join(indices)}}}" if indices else "")


def jaxpr_to_formula(program, arrays: list[np.ndarray], symbols: list) -> list:
    """The results of a program as SymPy expressions: of numbers for its first inputs, and symbols for the rest."""
    entries = iter(symbols)
    inputs = [_constant(x, None) for x in arrays]
    for variable in program.jaxpr.invars[len(arrays) :]:
        inputs.append(_filled([next(entries) for _ in range(variable.aval.size)], variable.aval.shape))
    # Many entries contain the same sines and cosines.
    combined = functools.cache(_combined)
    return [_simplified(x[()], combined) for x in interpreted(program, inputs, _applied, _constant)]


def _constant(x, aval) -> np.ndarray:
    x = np.asarray(x)
    return _filled([_number(y) for y in x.reshape(-1)], x.shape)


def _filled(entries: list, shape: tuple[int, ...]) -> np.ndarray:
    array = np.empty(len(entries), object)
    array[:] = entries
    return array.reshape(shape)


def _number(x: np.generic) -> Any:
    """A number as the first of these that equals it to round-off: a small fraction, a short decimal, all its digits."""
    sympy = sympy_itself()
    if not np.isfinite(x):
        return sympy.nan
    exact = Fraction(x.item())
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return sympy.Rational(exact)
    kind = jnp.finfo(x.dtype)
    simple = exact.limit_denominator(SMALL), Fraction(f"{x:.{kind.precision - 2}g}")
    close = (y for y in simple if abs(y - exact) <= 4 * float(kind.eps) * abs(exact))
    return sympy.Rational(next(close, Fraction(str(x))))


def _applied(equation, operands: list[np.ndarray]) -> list[np.ndarray]:
    """The results of a primitive for expressions."""
    name, params, shape = equation.primitive.name, equation.params, equation.outvars[0].aval.shape
    if name in ("convert_element_type", "stop_gradient"):
        return operands
    if name == "cumsum":
        order = slice(None, None, -1 if params["reverse"] else 1)
        columns = np.moveaxis(operands[0], params["axis"], 0)[order]
        return [np.moveaxis(np.cumsum(columns, axis=0)[order], 0, params["axis"])]
    if name in MOVING and name in MOVES:
        found = MOVES[name](params, equation.outvars, *operands)
        if found is not None:
            return found
    rows = list(zip(*(np.broadcast_to(x, shape).reshape(-1) for x in operands)))
    names = ("sin", "cos") if name == "sincos" else (name,)
    return [_filled([_result(one, params, *row) for row in rows], shape) for one in names]


def _result(name: str, params: dict, *x) -> Any:
    """The result of a primitive, as a sum of terms."""
    sympy = sympy_itself()
    # `integer_pow` has its exponent as a parameter.
    name, x = ("pow", (*x, params["y"])) if name == "integer_pow" else (name, x)
    if name not in FORMULAS:
        raise ValueError(
            f"the equations contain '{name}', which has no formula here.\n"
            "Usual cause: jnp.where, a table, a loop, or a special function in L.\nFix: print a system without it."
        )
    formula = FORMULAS[name]
    result = (getattr(sympy, formula) if isinstance(formula, str) else formula)(*x)
    if result.is_number and not result.is_Rational:
        # The sine or the root of a number is a number.
        return _number(np.float64(result)) if result.is_real else sympy.nan
    return _expanded(result)


def _expanded(x) -> Any:
    """A product or a power as a sum of terms, with the denominator as it is."""
    sympy = sympy_itself()
    # SymPy is not asked to expand what is too long.
    if _length(x) > TERMS:
        raise TooLong
    if x.is_Add:
        return x
    above, below = sympy.fraction(x)
    above = sympy.expand_multinomial(sympy.expand_mul(above, deep=False), deep=False)
    return sympy.Add(*(y / below for y in sympy.Add.make_args(above)))


def _length(x) -> int:
    """The most terms that an expression can have once it is expanded."""
    if x.is_Add or x.is_Mul:
        return (sum if x.is_Add else math.prod)(map(_length, x.args))
    if x.is_Pow and x.exp.is_Integer and x.exp > 0:
        return math.comb(_length(x.base) + int(x.exp) - 1, int(x.exp))
    return 1


def _simplified(formula, combined) -> Any:
    """The formula, with sums of sines and cosines that have the same factor combined, if that is shorter."""
    sympy = sympy_itself()
    sums = defaultdict(list)
    for term in sympy.Add.make_args(formula):
        factor, waves = term.as_independent(sympy.sin, sympy.cos)
        number, factor = factor.as_coeff_Mul()
        sums[factor].append(number * waves)
    formula = sympy.Add(*(_expanded(factor * combined(sympy.Add(*waves))) for factor, waves in sums.items()))
    above, below = sympy.fraction(sympy.together(formula))
    if _length(above) > TERMS:
        return formula
    return min(formula, sympy.expand(above) / below, key=sympy.count_ops)


def _combined(waves) -> Any:
    sympy = sympy_itself()
    if not (waves.is_Add and waves.has(sympy.sin, sympy.cos)):
        return waves
    return min(waves, sympy.expand_mul(sympy.trigsimp(waves)), key=sympy.count_ops)


def _verified(program, formulas, symbols, scalarised, s) -> float:
    """The largest relative difference of formulas and program at random states; raises if they do not agree."""
    given, flat = _arrays(scalarised.system), np.concatenate([np.ravel(x) for x in _arrays((s.params, *s[:3]))])
    run = jax.jit(lambda *inputs: eval_jaxpr(program.jaxpr, program.consts, *inputs))
    evaluate = sympy_itself().lambdify(symbols, formulas, "numpy", dummify=True, cse=True)
    variables = program.jaxpr.invars[len(given) :]
    ends = np.cumsum([x.aval.size for x in variables])[:-1]
    errors, random = [], np.random.default_rng(4)
    for _ in range(4 * STATES):
        at = flat + 0.25 * np.where(flat == 0, 1.0, np.abs(flat)) * random.standard_normal(flat.size)
        inputs = [y.reshape(x.aval.shape).astype(x.aval.dtype) for x, y in zip(variables, np.split(at, ends))]
        exact = np.asarray(run(*given, *inputs), float)
        with np.errstate(all="ignore"):
            values = np.asarray(evaluate(*(y for x in inputs for y in np.ravel(x).astype(float))), float)
        if np.all(np.isfinite(exact)):
            errors.append(np.max(np.abs(values - exact) / (1e-3 * np.max(np.abs(exact)) + np.abs(exact))))
        if len(errors) == STATES:
            break
    # NaN if a formula has no value where the program has one.
    worst = float(np.max(errors, initial=0.0))
    if len(errors) < STATES or not worst <= (AGREE if flat.dtype == np.float64 else 1e-3):
        raise ValueError(
            f"the formulas differ from the program by {worst:.0e} and are not shown.\n"
            "Usual cause: a root or power of an expression that changes sign.\nFix: write it so that it does not."
        )
    return worst


def _lines(names: list[str], held: list[str], symbols: dict[Any, str], formulas: list) -> list[str]:
    """Each equation in LaTeX."""
    sympy = sympy_itself()
    accelerations = {sympy.Symbol(f"4{name}"): written(name, r"\ddot") for name in names}
    multipliers = {sympy.Symbol(f"5{name}"): rf"\lambda_{{{written(name)}}}" for name in held}
    texts, n, m = symbols | accelerations | multipliers, len(names), len(held)
    mass, forcing, rows, residuals = np.split(_filled(formulas, (-1,)), np.cumsum([n * n, n, m * n]))

    def total(factors, coefficients):
        short = (min(x, sympy.factor_terms(x), key=sympy.count_ops) for x in coefficients)
        return sympy.Add(*(x * y for x, y in zip(factors, short)))

    left = [total(accelerations, mass[i * n : (i + 1) * n]) for i in range(n)]
    right = [forcing[i] + total(multipliers, rows[i::n]) for i in range(n)]
    pairs = [*zip(left, right), *((x, sympy.Integer(0)) for x in residuals)]
    return [f"{typeset(x, texts)} = {typeset(y, texts)}" for x, y in pairs]


def typeset(formula, texts: dict[Any, str]) -> str:
    """A formula in LaTeX, its numbers as small fractions, or in the shortest digits that give the same float."""
    sympy = sympy_itself()
    shown = {}
    for x in formula.atoms(sympy.Rational):
        shown[x] = simple = _number(np.float64(x))
        if simple.q > SMALL or abs(simple) >= 10**6:
            # SymPy writes the digits like a symbol that comes before all others.
            digits, _, exponent = str(float(abs(simple))).removesuffix(".0").partition("e")
            text = digits + (rf" \cdot 10^{{{int(exponent)}}}" if exponent else "")
            symbol = sympy.Symbol(f" {text}", positive=True)
            shown[x], texts = symbol if x > 0 else -symbol, texts | {symbol: text}
    return sympy.latex(formula.xreplace(shown), symbol_names=texts, ln_notation=True, inv_trig_style="full")
