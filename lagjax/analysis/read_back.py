"""Lagrange's equations of a small system as formulas, read back from the program that computes them.

The program of M, F and A is expanded into scalar operations (`in_numbers.py`) and run on formulas in place of numbers
(`expressions.py`). The resulting formulas are then evaluated at random states and compared with the program.

Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (2.26), whose equations these are.
"""

from fractions import Fraction

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax.core import eval_jaxpr

from lagjax.analysis import expressions, typeset
from lagjax.analysis.expressions import Formula, function, number, symbol, tidy
from lagjax.jax_internals.programs import Literal
from lagjax.mechanics import constraints, coordinates
from lagjax.mechanics.diagnosis import equation_names
from lagjax.mechanics.first_call import traced_system
from lagjax.mechanics.in_numbers import Numbers, in_numbers
from lagjax.mechanics.lagrangian import mass_and_forcing
from lagjax.mechanics.refusals import check_system
from lagjax.numerics import scalars

# Beyond these numbers of operations and coordinates the equations are too long to read.
OPERATIONS, COORDINATES = 2000, 8
# Formulas that differ from the program by more than this are not shown.
AGREE = 1e-9
STATES = 16


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
    l^{2} m \ddot{\theta} = -g m \sin(\theta)

    **Arguments:** `q` and `v` of the same structure, `params` as the system takes it, `t` scalar: their names become
    the symbols; numbers inside the functions are written as numbers.

    **Returns:** an `EquationsOfMotion`: one equation per coordinate, `Σ M a = F + Aᵀ λ`, with multipliers λ named after
    their constraints, and each constraint `g = 0` or `phi = 0`. Products are expanded.

    **Raises:** `ValueError` for a system that is not small, whose program has loops, branches or functions without a
    formula, or if the formulas do not agree with the program; as `accelerations` for a state of the wrong kind.

    Source: Goldstein, *Classical Mechanics*, Eq. (1.57), (2.26).
    """
    check_system(system, q, v, params)
    s = coordinates.state(t, q, v, jax.tree.map(lambda x: float(x) if type(x) is int else x, params))
    try:
        system = traced_system(system, s)
    except (TypeError, IndexError):
        # An integer that is used as a count or an index must stay an integer.
        s = coordinates.state(t, q, v, params)
        system = traced_system(system, s)
    n = len(coordinates.names(s.q))
    if n > COORDINATES:
        raise ValueError(f"the system has {n} coordinates, but equations are written only for up to {COORDINATES}.")
    _, unflatten = coordinates.flatten(s.q)
    scalarised = in_numbers(system, unflatten)
    args = scalarised, s.t, coordinates.numbers(s.q), coordinates.numbers(s.v), s.params
    try:
        program = Numbers(_parts, args, most=OPERATIONS).program
        formulas, names = _formulas(program, scalarised, s)
    except (scalars.TooLong, expressions.TooLong):
        raise ValueError(
            "the equations are too long to be read.\n"
            "Usual cause: an L with sums over many parts, or a quadrature.\nFix: print a system with fewer parts."
        ) from None
    error = _verified(program, formulas, names, scalarised, s)
    return EquationsOfMotion(tuple(_lines(system, s, formulas)), error, STATES)


def _parts(system, t, q, v, params):
    """The entries of M, F, A and the constraints; A includes the derivative of a force by the multipliers."""
    x, unflatten = coordinates.flatten(q)
    u, _ = coordinates.flatten(v)
    linear = mass_and_forcing(system, t, x, u, params, unflatten)
    rows = constraints.jacobian(system, t, x, u, params, unflatten)
    if linear.response is not None:
        rows = rows + linear.response.T
    held = [jnp.ravel(c.residual(t, q, v, params)) for c in system.constraints.values()]
    return [*_numbers(linear.mass), *_numbers(linear.forcing), *_numbers(rows), *(y for x in held for y in _numbers(x))]


def _numbers(array):
    flat = array.reshape(-1)
    return [flat[i] for i in range(flat.size)]


def _symbols(s) -> tuple[list[Formula], list[str]]:
    """The symbols of t, coordinates, velocities and parameters, in the order of the program's inputs; their names."""
    names = coordinates.names(s.q)
    leaves = eqx.filter(s.params, eqx.is_array)
    known = [] if not jtu.tree_leaves(leaves) else coordinates.names(leaves)
    if jtu.treedef_is_leaf(jtu.tree_structure(s.params)):
        known = [name.replace("q", "params", 1) for name in known]
    position = lambda name: typeset.written(name)
    short = [name.split(".")[-1] for name in known]
    # Parameters with the same last name, such as the masses of two bodies, get the body as an index.
    letters = [x if short.count(x) == 1 else "_".join(reversed(name.split("."))) for x, name in zip(short, known)]
    entries = [("t", "t", 1)]
    entries += [(f"q:{name}", position(name), 2) for name in names]
    entries += [(f"v:{name}", rf"\dot{{{position(name)}}}", 3) for name in names]
    entries += [(f"p:{name}", typeset.written(letter), 0) for name, letter in zip(known, letters)]
    return [symbol(*one) for one in entries], [name for name, *_ in entries]


def _formulas(program, scalarised, s) -> tuple[list[Formula], list[str]]:
    jaxpr = program.jaxpr
    symbols, names = _symbols(s)
    values = dict(zip(jaxpr.constvars, map(_known, program.consts)))
    inputs, given = iter(symbols), jtu.tree_leaves(eqx.filter(scalarised, eqx.is_array))
    for i, variable in enumerate(jaxpr.invars):
        size, shape = int(np.prod(variable.aval.shape)), variable.aval.shape
        # Arrays inside the functions come first and have no names.
        entries = _known(given[i]) if i < len(given) else _filled([next(inputs) for _ in range(size)], shape)
        values[variable] = entries
    read = lambda x: _known(x.val) if isinstance(x, Literal) else values[x]
    for equation in jaxpr.eqns:
        results = _applied(equation, [read(x) for x in equation.invars])
        values.update(zip(equation.outvars, results))
    return [tidy(read(x)[()]) for x in jaxpr.outvars], names


def _known(x) -> np.ndarray:
    x = np.asarray(x)
    return _filled([number(float(y)) for y in x.reshape(-1)], x.shape)


def _filled(entries, shape) -> np.ndarray:
    array = np.empty(len(entries), object)
    for i, entry in enumerate(entries):
        array[i] = entry
    return array.reshape(shape)


def _applied(equation, operands) -> list[np.ndarray]:
    name, params, shapes = equation.primitive.name, equation.params, [x.aval.shape for x in equation.outvars]
    if name == "reshape" or name == "squeeze":
        return [operands[0].reshape(shapes[0])]
    if name == "slice":
        strides = params["strides"] or [1] * operands[0].ndim
        return [operands[0][tuple(map(slice, params["start_indices"], params["limit_indices"], strides))]]
    if name == "concatenate":
        return [np.concatenate(operands, params["dimension"])]
    if name == "unstack":
        parts = np.moveaxis(operands[0], params["axis"], 0)
        return [_filled(list(parts[i : i + 1].reshape(-1)), shape) for i, shape in enumerate(shapes)]
    if name == "stack":
        axis = params["axis"]
        return [np.stack([x.reshape(shapes[0][:axis] + shapes[0][axis + 1 :]) for x in operands], axis)]
    if name in ("convert_element_type", "copy", "stop_gradient"):
        return [operands[0]]
    if name == "sincos":
        return [_each("sin", params, operands, shapes[0]), _each("cos", params, operands, shapes[0])]
    return [_each(name, params, operands, shapes[0])]


def _each(name, params, operands, shape) -> np.ndarray:
    rows = [np.broadcast_to(x, shape).reshape(-1) for x in operands]
    return _filled([_apply_scalar(name, params, *x) for x in zip(*rows)], shape)


def _apply_scalar(name, params, *x: Formula) -> Formula:
    """The result of applying a primitive to formulas."""
    if name in ("add", "add_any"):
        return x[0] + x[1]
    if name == "sub":
        return x[0] - x[1]
    if name == "mul":
        return x[0] * x[1]
    if name == "neg":
        return -x[0]
    if name == "div":
        return x[0] * x[1].power(-1)
    if name == "integer_pow":
        return x[0].power(params["y"])
    if name == "pow" and x[1].constant is not None:
        return x[0].power(Fraction(x[1].constant).limit_denominator(64))
    roots = {"sqrt": Fraction(1, 2), "rsqrt": Fraction(-1, 2), "square": 2, "cbrt": Fraction(1, 3)}
    if name in roots:
        return x[0].power(roots[name])
    if name in expressions.FUNCTIONS:
        return function(name, x[0])
    raise ValueError(
        f"the equations contain '{name}', which has no formula here.\n"
        "Usual cause: jnp.where, a table, a loop, or a special function in L.\nFix: print a system without it."
    )


def _verified(program, formulas, names, scalarised, s) -> float:
    """The largest relative difference of formulas and program at random states; raises if they do not agree."""
    given = jtu.tree_leaves(eqx.filter(scalarised, eqx.is_array))
    leaves = [np.asarray(x) for x in jtu.tree_leaves(eqx.filter((s.t, *s[1:]), eqx.is_array))]
    flat = np.concatenate([np.ravel(x) for x in leaves])
    run = jax.jit(lambda *inputs: eval_jaxpr(program.jaxpr, program.consts, *inputs))
    worst, count = 0.0, 0
    random = np.random.default_rng(4)
    for _ in range(4 * STATES):
        at = flat * (1 + 0.25 * random.standard_normal(flat.size)) + 0.25 * random.standard_normal(flat.size) * (
            flat == 0
        )
        inputs, start = [], 0
        for variable in program.jaxpr.invars[len(given) :]:
            size = int(np.prod(variable.aval.shape))
            inputs.append(at[start : start + size].reshape(variable.aval.shape).astype(variable.aval.dtype))
            start += size
        exact = np.asarray([float(x) for x in run(*given, *inputs)])
        by_name = dict(zip(names, at))
        with np.errstate(all="ignore"):
            values = np.asarray([formula.value(by_name) for formula in formulas])
        if np.all(np.isfinite(exact)):
            count += 1
            worst = max(worst, float(np.max(np.abs(values - exact) / (1e-3 * np.max(np.abs(exact)) + np.abs(exact)))))
        if count == STATES:
            break
    if count < STATES or not worst <= (AGREE if flat.dtype == np.float64 else 1e-3):
        raise ValueError(
            f"the formulas differ from the program by {worst:.0e} and are not shown.\n"
            "Usual cause: a root or power of an expression that changes sign.\nFix: write it so that it does not."
        )
    return worst


def _lines(system, s, formulas):
    """Each equation in LaTeX."""
    names, held = coordinates.names(s.q), equation_names(system, s)
    n, m = len(names), len(held)
    mass = np.reshape(_filled(formulas[: n * n], (n * n,)), (n, n))
    forcing, rest = formulas[n * n : n * n + n], formulas[n * n + n :]
    rows = np.reshape(_filled(rest[: m * n], (m * n,)), (m, n))
    for i in range(n):
        left = [(mass[i, j], rf"\ddot{{{typeset.written(names[j])}}}") for j in range(n)]
        right = [(rows[k, i], rf"\lambda_{{\mathrm{{{held[k]}}}}}") for k in range(m)]
        force = typeset.latex(forcing[i]) if forcing[i].terms else ""
        pushed = typeset.combined(right)
        joined = pushed if not force else force if not pushed else force + typeset.plus(pushed)
        yield f"{typeset.combined(left) or '0'} = {joined or '0'}"
    for formula in rest[m * n :]:
        yield f"{typeset.latex(formula)} = 0"
