"""Lagrange's equations of a small system as formulas: the program of L becomes an expression, and the rest is SymPy's.

Each primitive in the programs of L, the forces and the constraints has a function of SymPy's. SymPy derives

    Σ_j M_ij a_j = F_i + Σ_k λ_k A_ki,    M = ∂p/∂v,  p = ∂L/∂v,  F = ∂L/∂q - ∂p/∂t - (∂p/∂q) v + Q - ∂R/∂v

simplifies and typesets. The formulas are then evaluated at random states and compared with what JAX computes.

Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (2.26), whose equations these are.
"""

import math
import re
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
from jaxtyping import Array, PyTree

from lagjax.exchange import sympy_itself
from lagjax.jaxtools import LARGE, MOVING, ClosedJaxpr, TooLong, equations, interpreted, written_out
from lagjax.mechanics import mass_and_forcing
from lagjax.system import Model, check_system, checked, constraints, coordinates, model_of

# Beyond these numbers of coordinates, of operations and of terms the equations are too long to read.
COORDINATES, OPERATIONS, TERMS = 8, 2000, 400
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


def latex(system, q: PyTree, v: PyTree, params: PyTree = None, *, t=0.0) -> EquationsOfMotion:
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
    their constraints, and each constraint `g = 0` or `phi = 0`. Products are expanded, and sines and cosines combined,
    where that is shorter.

    **Raises:**

    - `ImportError` without SymPy (extra `sympy`).
    - `ValueError` for a system that is not small, whose functions have loops, branches or functions without a formula,
      or if the formulas do not agree with the program.
    - As `accelerations` for a state of the wrong kind.

    Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (2.26).
    """
    check_system(system, q, v, params, states=False)
    sympy_itself("lj.latex")
    system, s = checked(system, coordinates.State(t, q, v, params))
    model = model_of(system, *s)
    if model.n > COORDINATES:
        raise ValueError(
            f"the system has {model.n} coordinates, but equations are written only for up to {COORDINATES}."
        )
    unknown = np.zeros(model.m + model.n, jax.dtypes.canonicalize_dtype(float))
    inputs = s.t, *model.vectors(s.q, s.v), eqx.filter(s.params, eqx.is_array), *np.split(unknown, [model.m])
    numbers = coordinates.vector(inputs)
    # Whole numbers among the parameters stay whole at random states.
    whole = jax.tree.map(lambda x: np.full(x.shape, not jnp.issubdtype(x.dtype, jnp.inexact)), inputs)

    def state(numbers):
        given = coordinates.like(inputs, numbers)
        t, x, u, arrays, multipliers, a = jax.tree.map(lambda x, like: x.astype(like.dtype), given, inputs)
        return model.of(eqx.combine(arrays, s.params)), t, x, u, multipliers, a

    symbols = _symbols(model, s)
    try:
        sides = _equations(state, numbers, list(symbols), model)
    except TooLong:
        raise ValueError(
            "the equations are too long to be read.\n"
            "Usual cause: an L with sums over many parts, or a quadrature.\nFix: print a system with fewer parts."
        ) from None
    error = _verified(state, numbers, coordinates.vector(whole), list(symbols), sides)
    lines = (" = ".join(typeset(side, symbols) for side in pair) for pair in sides)
    return EquationsOfMotion(tuple(lines), error, STATES)


def _symbols(model: Model, s: coordinates.State) -> dict[Any, str]:
    """The symbols of t, q, v, the parameters, multipliers and accelerations, with their LaTeX.

    The first character of a symbol's own name is its place among the factors of a product, and keeps names apart.
    """
    names, leaves = model.names, eqx.filter(s.params, eqx.is_array)
    known = coordinates.names(leaves) if jtu.tree_leaves(leaves) else []
    if jtu.treedef_is_leaf(jtu.tree_structure(s.params)):
        known = [name.replace("q", "params", 1) for name in known]
    short = [name.split(".")[-1] for name in known]
    # Parameters with the same last name, such as the masses of two bodies, get the body as an index.
    letters = [x if short.count(x) == 1 else "_".join(reversed(name.split("."))) for x, name in zip(short, known)]
    entries = [("1", "t"), *((f"2{name}", written(name)) for name in names)]
    entries += [(f"3{name}", written(name, r"\dot")) for name in names]
    entries += [(f"0{name}", written(letter)) for name, letter in zip(known, letters)]
    entries += [(f"5{name}", rf"\lambda_{{{written(name)}}}") for name in model.equation_names]
    entries += [(f"4{name}", written(name, r"\ddot")) for name in names]
    return {sympy_itself().Symbol(key, real=True): text for key, text in entries}


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


def _equations(state: Callable, numbers: np.ndarray, symbols: list, model: Model) -> list[tuple]:
    """The left and the right side of each equation."""
    n = model.n

    def functions(*numbers):
        model, t, x, u, multipliers, _ = state(jnp.stack(numbers))
        dissipation = 0.0 if model.system.dissipation is None else model.dissipation(t, x, u)
        force = jnp.zeros(n) if model.system.force is None else model.force(t, x, u, multipliers)
        values = model.lagrangian(t, x, u), dissipation, force, *_residuals(model, t, x, u)
        return [y for value in values for y in jnp.ravel(value)]

    energy, dissipation, *rest = jaxpr_to_formula(jax.make_jaxpr(functions)(*numbers), symbols)
    force, residuals = rest[:n], rest[n:]
    (t, *x), u, a = symbols[: n + 1], symbols[n + 1 : 2 * n + 1], symbols[-n:]
    multipliers = symbols[-n - model.m : -n]
    found = []
    for i, p in enumerate(energy.diff(v) for v in u):
        left = sum(p.diff(v) * y for v, y in zip(u, a))
        # A constraint pushes along the gradient of its residual, by positions or by velocities.
        pushes = (g.diff(x[i] if of_q else u[i]) for g, of_q in zip(residuals, model.holonomic))
        right = energy.diff(x[i]) - p.diff(t) - sum(p.diff(y) * v for y, v in zip(x, u))
        right += force[i] - dissipation.diff(u[i]) + sum(map(mul, multipliers, pushes))
        found.append((_linear(left, a), _linear(right, multipliers)))
    return found + [(simplified(g), sympy_itself().Integer(0)) for g in residuals]


def _residuals(model: Model, t, x, u) -> list[Array]:
    q, v = model.tree(x), model.tree(u)
    return [c.residual(t, q, v, model.params) for c in model.system.constraints.values()]


def _linear(side, unknowns: list) -> Any:
    """An expression linear in some unknowns, simplified, and so each of their factors."""
    sympy = sympy_itself()
    # JAX's derivative of a sign is zero.
    side = sympy.sympify(side).replace(sympy.DiracDelta, lambda *_: sympy.Integer(0))
    factors = (simplified(side.diff(y)) for y in unknowns)
    short = (min(x, sympy.factor_terms(x), key=sympy.count_ops) for x in factors)
    return simplified(side.xreplace(dict.fromkeys(unknowns, sympy.Integer(0)))) + sum(map(mul, short, unknowns))


def jaxpr_to_formula(program: ClosedJaxpr, symbols: list) -> list:
    """The results of a program of single numbers as SymPy expressions of one symbol for each of them."""
    if any(x.aval.size > LARGE for equation in equations(program.jaxpr) for x in equation.outvars):
        raise TooLong
    in_numbers = jax.make_jaxpr(lambda *x: written_out(program, *x, most=OPERATIONS))(*program.in_avals)
    return interpreted(in_numbers, symbols, _applied, _number)


def _applied(equation, operands: list) -> list:
    """The results of a primitive for expressions."""
    sympy, name = sympy_itself(), equation.primitive.name
    if name == "convert_element_type" or name in MOVING and equation.outvars[0].aval.size == len(operands) == 1:
        return operands
    if name in MOVING:
        # The arrays that an operation without a formula takes.
        return [None for _ in equation.outvars]
    if name == "integer_pow":
        name, operands = "pow", [*operands, equation.params["y"]]
    found = []
    for one in ("sin", "cos") if name == "sincos" else (name,):
        if one not in FORMULAS:
            raise ValueError(
                f"the equations contain '{one}', which has no formula here.\n"
                "Usual cause: jnp.where, a table, a loop, or a special function in L.\nFix: print a system without it."
            )
        result = (getattr(sympy, FORMULAS[one]) if isinstance(FORMULAS[one], str) else FORMULAS[one])(*operands)
        if result.is_number and not result.is_Rational:
            # The sine or the root of a number is a number.
            result = _number(np.float64(result)) if result.is_real else sympy.nan
        found.append(result)
    return found


def _number(x, aval=None) -> Any:
    """A number as the first of these that equals it to round-off: a small fraction, a short decimal, all its digits."""
    sympy, x = sympy_itself(), np.asarray(x, None if aval is None else aval.dtype)
    if not np.isfinite(x):
        return sympy.nan
    exact = Fraction(x.item())
    if not jnp.issubdtype(x.dtype, jnp.floating):
        return sympy.Rational(exact)
    kind = jnp.finfo(x.dtype)
    simple = exact.limit_denominator(SMALL), Fraction(f"{x.item():.{kind.precision - 2}g}")
    close = (y for y in simple if abs(y - exact) <= 4 * float(kind.eps) * abs(exact))
    return sympy.Rational(next(close, Fraction(str(x))))


def simplified(formula) -> Any:
    """The shortest of some equal formulas: products expanded, sines and cosines combined, one denominator."""
    sympy = sympy_itself()
    if formula.count_ops() > OPERATIONS or _terms(formula) > TERMS:
        raise TooLong
    forms = [sympy.expand_mul(formula)]
    if formula.has(sympy.sin, sympy.cos):
        forms.append(sympy.expand_mul(sympy.trigsimp(forms[0])))
    above, below = sympy.fraction(sympy.together(forms[0]))
    if _terms(above) <= TERMS:
        forms.append(sympy.expand_mul(above) / below)
    return min(*forms, formula, key=sympy.count_ops)


def _terms(formula) -> int:
    """How many terms a formula has once its products are expanded."""
    if formula.is_Add:
        return sum(map(_terms, formula.args))
    return math.prod(map(_terms, formula.args)) if formula.is_Mul else 1


def _verified(state: Callable, numbers: np.ndarray, whole: np.ndarray, symbols: list, sides: list[tuple]) -> float:
    """The largest relative difference of formulas and program at random states; raises if they do not agree."""

    def exactly(numbers):
        model, t, x, u, multipliers, a = state(numbers)
        linear, push = mass_and_forcing(model, t, x, u), constraints.jacobian(model, t, x, u).T @ multipliers
        right = linear.forcing + (push if linear.response is None else push + linear.response @ multipliers)
        held = [jnp.ravel(g) for g in _residuals(model, t, x, u)]
        return jnp.concatenate([linear.mass @ a, *held, right])

    random = np.random.default_rng(4).standard_normal((4 * STATES, numbers.size))
    spread = 0.25 * np.where(numbers == 0, 1.0, np.abs(numbers)) * ~whole
    states = (numbers + spread * random).astype(numbers.dtype)
    exact = np.asarray(jax.jit(jax.vmap(exactly))(states), float)
    known = np.all(np.isfinite(exact), axis=1)
    states, exact = states[known][:STATES], exact[known][:STATES]
    left, right = zip(*sides)
    formulas = [*left, *right][: exact.shape[1]]
    evaluate = sympy_itself().lambdify(symbols, formulas, "numpy", dummify=True, cse=True)
    with np.errstate(all="ignore"):
        values = np.array([evaluate(*row) for row in states.astype(float)], float).reshape(exact.shape)
    scale = np.abs(exact) + 1e-3 * np.max(np.abs(exact), axis=1, keepdims=True)
    # NaN if a formula has no value where the program has one.
    worst = float(np.max(np.abs(values - exact) / scale, initial=0.0))
    if len(states) < STATES or not worst <= (AGREE if numbers.dtype == np.float64 else 1e-3):
        raise ValueError(
            f"the formulas differ from the program by {worst:.0e} and are not shown.\n"
            "Usual cause: a root or power of an expression that changes sign.\nFix: write it so that it does not."
        )
    return worst


def typeset(formula, texts: dict[Any, str]) -> str:
    """A formula in LaTeX, its numbers as small fractions, or in the shortest digits that give the same float."""
    sympy = sympy_itself()
    shown = {x: _number(np.float64(x)) for x in formula.atoms(sympy.Rational)}
    long = {x: sympy.Float(repr(float(x))) for x, y in shown.items() if y.q > SMALL or abs(y) >= 10**15}
    return sympy.latex(formula.xreplace(shown | long), symbol_names=texts, ln_notation=True, inv_trig_style="full")
