"""Programs (jaxprs) with their jumps laid open: each comparison of numbers that move becomes an input of the program.

A function of a state that jumps or has a kink does so where one of its comparisons changes: `x > y`, `sign`, `abs`,
`max`, `min`, `clamp`, `floor`, `ceil`, `round`, a remainder, the conversion to a whole number, the place in a sorted
table. `opened` rewrites the program as a function that is smooth in its arguments, given the outcome of each of these
comparisons, the *mode*, as one more argument. It also gives, for each mode, the number that is above zero as long as
the mode is the true one (the guard), and the mode beyond.

A mode is one number: 0 or 1 for a comparison (`a > b`), a whole number for a level (`floor`). Comparisons of the same
two numbers have one mode, wherever they stand, so that programs are told apart by what they compute: each value has a
number of its own in a `JumpTable`, shared by several programs.

The bounds of values, as far as the operations say (a cosine is between -1 and 1, a square not negative), tell which
comparisons are decided once and for all, as those that only guard a root or a quotient against round-off:
`jnp.where(r > 0, r, 1.0)` of a distance r, `jnp.arccos(jnp.clip(jnp.cos(q), -1, 1))`.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal
from jaxtyping import PyTree

from lagjax.jaxtools.jaxpr import bodies, equations, evaluate, needed, stands_for, written

Bounds = tuple[float, float]
ALL = (-math.inf, math.inf)
OF_RESULT = {"cos": (-1.0, 1.0), "sin": (-1.0, 1.0), "tanh": (-1.0, 1.0), "erf": (-1.0, 1.0), "logistic": (0.0, 1.0),
             "exp": (0.0, math.inf), "exp2": (0.0, math.inf), "sqrt": (0.0, math.inf), "rsqrt": (0.0, math.inf),
             "square": (0.0, math.inf), "cosh": (1.0, math.inf)}  # fmt: skip
PASSES_BOUNDS = {
    "broadcast_in_dim", "convert_element_type", "copy", "reshape", "rev", "slice", "squeeze", "stop_gradient",
    "transpose", "gather", "dynamic_slice", "reduce_max", "reduce_min", "expand_dims",
}  # fmt: skip
JOINS_BOUNDS = {"concatenate", "stack", "select_n"}

COMPARISONS = {"gt", "ge", "lt", "le"}
KINKS = {"abs", "max", "min", "clamp"}
LEVELS = {"floor", "ceil", "round", "rem", "convert_element_type"}
OUTCOMES = {"sign", "floor", "ceil", "round"}
# What a value may depend on besides t, q, v and multipliers: outcomes of comparisons, and of those of t alone.
OUTCOME, IN_TIME = "outcome", "outcome in time"
ELEMENTARY = COMPARISONS | KINKS | LEVELS | {"sign"}
# They choose among numbers, one at a time; their jumps are not followed.
CHOOSING = {"reduce_max", "reduce_min", "argmax", "argmin", "sort", "cummax", "cummin", "top_k"}
# Functions with a derivative of their own count as smooth, but for these.
WITH_KINKS = {"relu", "relu6", "hard_tanh", "leaky_relu"}
# Functions that are smooth, and are put together from several formulas.
SMOOTH = {
    "hypot", "i0", "i0e", "i1", "i1e", "expi", "exp1", "expn", "betainc", "spence", "zeta", "polygamma", "log_ndtr",
    "ndtr", "ndtri", "erfcx", "sinc", "entr", "gammainc", "gammaincc", "bessel_jn", "fresnel", "hyp1f1", "lambertw",
    # Equinox's checks, which `one_function.poisoned` knows by this name; and `judging`.
    "branched_error_if_impl", "judgement",
}  # fmt: skip
# Operations on arrays of more numbers are not followed: those of a network, or of a picture.
LARGEST = 16


def bounds_of_number(x) -> Bounds:
    """The bounds of a known array."""
    x = np.asarray(x)
    if x.dtype.kind not in "fiu" or not x.size or np.isnan(x).any():
        return ALL
    return float(x.min()), float(x.max())


def bounds_of_result(equation: JaxprEqn, operands: Sequence[Bounds]) -> Bounds:
    """The bounds of the first result of a primitive, from those of its operands."""
    name = equation.primitive.name
    if name in OF_RESULT:
        return OF_RESULT[name]
    if name in PASSES_BOUNDS:
        return operands[0]
    if name in JOINS_BOUNDS:
        chosen = operands[1:] if name == "select_n" else operands
        return min(low for low, _ in chosen), max(high for _, high in chosen)
    if name == "integer_pow" and equation.params["y"] % 2 == 0:
        return 0.0, math.inf
    if name == "abs":
        low, high = operands[0]
        return (max(low, -high, 0.0), max(-low, high))
    if name == "neg":
        return -operands[0][1], -operands[0][0]
    if name in ("add", "add_any", "sub"):
        (a, b), (c, d) = operands[0], operands[1] if name != "sub" else (-operands[1][1], -operands[1][0])
        return a + c, b + d
    if name in ("mul", "div", "dot_general", "reduce_sum") and all(low >= 0 for low, _ in operands):
        return 0.0, math.inf
    if name == "mul" and equation.invars[0] is equation.invars[1]:
        return 0.0, math.inf
    if name in ("max", "min"):
        of = max if name == "max" else min
        return of(operands[0][0], operands[1][0]), of(operands[0][1], operands[1][1])
    return ALL


def judging(function: Callable) -> Callable:
    """The same function, in which no jumps are looked for: it judges whether numbers are good, as checks do.

    >>> print(judging(lambda x: x > 0)(jnp.asarray(2.0)))
    True
    """

    def judgement(*args):
        return function(*args)

    return jax.jit(judgement)


class Slot(NamedTuple):
    """A mode, or an array of `shape` of them: what compares, and on what its numbers depend ("t", "q", "v").

    `levels`: whether the mode is a whole number. `roles`: the programs in which it occurs; `jumps`: those of them in
    which it is not only a kink.
    """

    kind: str
    depends: frozenset
    jumps: frozenset
    levels: bool
    roles: frozenset
    shape: tuple[int, ...]


class Timed(NamedTuple):
    """A jump that depends on t alone: its mode, a whole number, where the number x is.

    `at`: the time of the jump, if it stands in the program; else None. `rule`: of the mode, "above" or a level's;
    `table`: that of a place.
    """

    actual: Any
    x: Any
    at: Any
    rule: str
    table: Any


@dataclass
class JumpTable:
    """The numbers of values, and the slots found so far, for several programs over the same state.

    `negative`: for the numbers of values -x, that of x. `slots` by key, in order; `missed`: what is not followed, in
    words.
    """

    numbers: dict = field(default_factory=dict)
    negative: dict[int, int] = field(default_factory=dict)
    slots: dict[Any, Slot] = field(default_factory=dict)
    missed: dict[str, None] = field(default_factory=dict)

    def number(self, *key) -> int:
        """The number of a value that is computed like this."""
        return self.numbers.setdefault(key, len(self.numbers))


class KnownValue(NamedTuple):
    """A value in a program, its number in the table, on what of the state it depends, and its bounds."""

    value: Any
    number: int
    depends: frozenset
    bounds: Bounds = ALL


class Inside(NamedTuple):
    """A mode's guard, above zero as long as the mode is the true one; the mode beyond it; the difference compared."""

    guard: Any
    beyond: Any
    actual: Any
    raw: Any


def has_jumps(jaxpr: Jaxpr) -> bool:
    """Whether there is anything in a program, or in one inside it, that could jump or have a kink."""
    wanted = ELEMENTARY - {"convert_element_type"} | CHOOSING
    return any(
        e.primitive.name in wanted and any(_is_float(x.aval) for x in e.invars)
        or e.primitive.name == "convert_element_type" and _to_whole(e)
        for e in equations(jaxpr)
    )  # fmt: skip


class JumpOpening:
    """A walk over a program that takes modes for its comparisons.

    `mode(key, actual)` gives the modes to use for those that the numbers themselves would give. `inside`: the guard of
    each mode; `timed`: the jumps that depend on t alone, which are left as they are; both by key.
    """

    def __init__(self, table: JumpTable, role: str, mode: Callable):
        self.table, self.role, self.mode = table, role, mode
        self.inside: dict[Any, Inside] = {}
        self.timed: dict[Any, Timed] = {}
        # Inside of `interp`: by the number of what is looked up, whether it is below and above the whole table.
        self._beyond_table: dict[int, tuple] = {}

    def run(self, closed: ClosedJaxpr, inputs: list[KnownValue]) -> list[KnownValue]:
        """The results of a program."""
        jaxpr, constants = closed.jaxpr, closed.consts
        # What is not used, as the sign that `logsumexp` could return, does not jump.
        jaxpr = jaxpr.replace(eqns=needed(jaxpr))
        values = {x: self._constant(c) for x, c in zip(jaxpr.constvars, constants)}
        values.update(zip(jaxpr.invars, inputs))

        def read(x: Any) -> Any:
            return self._constant(written(x)) if isinstance(x, Literal) else values[x]

        for equation in jaxpr.eqns:
            operands = [read(x) for x in equation.invars]
            values.update(zip(equation.outvars, self._results(jaxpr, equation, operands)))
        return [read(x) for x in jaxpr.outvars]

    def _constant(self, value):
        if isinstance(value, np.ndarray | np.generic | float | int) and np.size(value) == 1:
            # A weak type does not tell one zero from another.
            number = self.table.number("number", float(np.ravel(value)[0]))
            return KnownValue(value, number, frozenset(), bounds_of_number(value))
        # Held by the table's key: another object cannot get its address.
        return KnownValue(value, self.table.number("constant", _Held(value)), frozenset())

    def _results(self, jaxpr: Jaxpr, equation: JaxprEqn, operands: Sequence):
        name, depends = equation.primitive.name, frozenset().union(*(x.depends for x in operands))
        # What depends on outcomes alone changes only with them.
        if depends - {OUTCOME, IN_TIME}:
            inner = stands_for(equation)
            if name in ("jit", "closed_call") and inner is not None:
                if str(equation.params.get("name")) in SMOOTH:
                    at = {x: k.value for x, k in zip(equation.invars, operands) if not isinstance(x, Literal)}
                    return self._known(equation, operands, depends, evaluate(jaxpr, equation, at))
                if str(equation.params.get("name")) == "searchsorted":
                    # Not a call of its own, so that `interp` knows the place.
                    found = self._searched(equation, operands, depends)
                    if found is not None:
                        return found
                before = self._beyond_table
                found = self.run(inner, operands)
                self._beyond_table = before
                return found
            if name == "remat2" and inner is not None:
                return self.run(inner, operands)
            if name == "custom_jvp_call" and inner is not None and _called(equation) in WITH_KINKS:
                return self.run(inner, operands)
            if bodies(equation) and name not in ("custom_jvp_call", "custom_vjp_call"):
                # That a loop ends when something is small is no jump.
                inside = [body for key, body in _named_bodies(equation) if key != "cond_jaxpr"]
                if any(map(has_jumps, inside)):
                    self.table.missed[f"a comparison inside {_in_words(name)}"] = None
            elif name in CHOOSING and _is_float(equation.invars[0].aval) and not _is_only_a_scale(jaxpr):
                self.table.missed[f"{_in_words(name)}, which chooses among several numbers"] = None
            elif name in ELEMENTARY:
                taken = self._taken(equation, operands, depends)
                if taken is not None:
                    return self._known(equation, operands, depends, taken)
        at = {x: k.value for x, k in zip(equation.invars, operands) if not isinstance(x, Literal)}
        return self._known(equation, operands, depends, evaluate(jaxpr, equation, at))

    def _known(self, equation: JaxprEqn, operands: Sequence, depends, results: PyTree):
        name = equation.primitive.name
        if name == "convert_element_type" and jnp.issubdtype(equation.params["new_dtype"], jnp.floating):
            # The same number in another dtype.
            return [operands[0]._replace(value=results[0])]
        if name == "stop_gradient":
            return [operands[0]._replace(value=results[0])]
        params = () if not equation.params else str({k: v for k, v in equation.params.items() if k != "sharding"})
        key = self.table.number(name, params, *(x.number for x in operands))
        if name == "neg":
            self.table.negative[self.table.number("result", 0, key)] = operands[0].number
        if depends and (name in COMPARISONS | OUTCOMES or name == "convert_element_type" and _to_whole(equation)):
            depends = frozenset({IN_TIME if depends <= {"t", IN_TIME} else OUTCOME})
        bounds = bounds_of_result(equation, [x.bounds for x in operands])
        each = enumerate(results)
        return [KnownValue(y, self.table.number("result", i, key), depends, ALL if i else bounds) for i, y in each]

    # What each primitive does for given modes.

    def _taken(self, equation, operands: Sequence, depends):
        name = equation.primitive.name
        if not all(_is_float(x.aval) for x in equation.invars):
            return None
        values = [x.value for x in operands]
        size = int(np.prod(equation.outvars[0].aval.shape))
        if "multipliers" in depends:
            self.table.missed["a comparison of multipliers"] = None
            return None
        if size > LARGEST:
            self.table.missed[f"{_in_words(name)} of {size} numbers at once"] = None
            return None
        zero = self._constant(np.zeros((), operands[0].value.dtype))
        if operands[0].number in self._beyond_table and name in ("lt", "gt"):
            return [self._beyond_table[operands[0].number][name == "gt"]]
        if name in COMPARISONS:
            above = self._above(operands[0], operands[1], depends, True, name)
            return None if above is None else [above if name in ("gt", "ge") else ~above]
        if name == "sign":
            above = self._above(operands[0], zero, depends, True, name)
            return None if above is None else [jnp.where(above, 1.0, -1.0).astype(values[0].dtype)]
        if name == "abs":
            above = self._above(operands[0], zero, depends, False, name)
            return None if above is None else [jnp.where(above, values[0], -values[0])]
        if name in ("max", "min"):
            above = self._above(operands[0], operands[1], depends, False, name)
            first, second = values if name == "max" else values[::-1]
            return None if above is None else [jnp.where(above, first, second)]
        if name == "clamp":
            low, x, high = operands
            over = self._above(x, low, depends, False, name)
            under = self._above(x, high, depends, False, name)
            if over is None or under is None:
                return None
            return [jnp.where(under, high.value, jnp.where(over, x.value, low.value))]
        if name == "rem":
            x, y = values
            whole = self._level("trunc", x / y, operands, depends, name)
            return None if whole is None else [x - y * whole]
        if name == "convert_element_type":
            if not _to_whole(equation):
                return None
            whole = self._level("trunc", values[0], operands, depends, "a whole number")
            return None if whole is None else [whole.astype(equation.params["new_dtype"])]
        whole = self._level(name, values[0], operands, depends, name)
        return None if whole is None else [whole]

    def _above(self, a: KnownValue, b: KnownValue, depends, jumps, kind):
        """Whether a > b by the mode; both orders of a and b have one mode."""
        if a.bounds[0] >= b.bounds[1] or a.bounds[1] <= b.bounds[0]:
            # Decided once and for all: it guards against round-off.
            return None
        first, second = self._without_sign(a.number, b.number)
        turned = first > second
        key = ("above", *sorted((first, second)))
        raw = b.value - a.value if turned else a.value - b.value
        # At a tie as the user's comparison says: true for `a >= b`, and for its opposite `a < b`.
        at_tie = (kind in ("ge", "lt")) != turned
        actual = jnp.where(raw >= 0 if at_tie else raw > 0, 1.0, 0.0).astype(raw.dtype)
        # A time that stands in the program: `t > start`.
        time = [x.value for x, y in ((a, b), (b, a)) if y.number == self.table.number("t") and not x.depends]
        timed = Timed(actual, raw, jnp.broadcast_to(time[0], raw.shape) if time else None, "above", None)
        mode = self._mode(key, self._slot(kind, depends, jumps, False, raw.shape), timed)
        if mode is None:
            return None
        self.inside.setdefault(key, Inside((2 * mode - 1) * raw, 1 - mode, actual, raw))
        return mode < 0.5 if turned else mode > 0.5

    def _without_sign(self, first, second):
        # -y > 0 is 0 > y, and 0 > -y is y > 0.
        zero, negative = self.table.number("number", 0.0), self.table.negative
        if second == zero and first in negative:
            return zero, negative[first]
        return (negative[second], zero) if first == zero and second in negative else (first, second)

    def _level(self, rule, x, operands: Sequence, depends, kind):
        """The whole number that belongs to x, by the mode."""
        key = ("level", rule, *(k.number for k in operands))
        actual = {"floor": jnp.floor, "ceil": jnp.ceil, "round": jnp.round, "trunc": jnp.trunc}[rule](x)
        slot = self._slot(kind, depends, True, True, x.shape)
        mode = self._mode(key, slot, Timed(actual, x, None, rule, None))
        if mode is None:
            return None
        if rule == "floor":
            low, high = mode, mode + 1
        elif rule == "ceil":
            low, high = mode - 1, mode
        elif rule == "round":
            low, high = mode - 0.5, mode + 0.5
        else:
            low, high = jnp.where(mode > 0, mode, mode - 1), jnp.where(mode < 0, mode, mode + 1)
        up = x - low > high - x
        beyond = jnp.where(up, mode + 1, mode - 1)
        self.inside.setdefault(key, Inside((x - low) * (high - x), beyond, actual, x))
        return mode

    def _searched(self, equation, operands: Sequence, depends):
        """The place of a number in a sorted table, by the mode."""
        arrays = [x for x in operands if jnp.ndim(x.value) == 1]
        numbers = [x for x in operands if jnp.ndim(x.value) == 0]
        if len(arrays) != 1 or len(numbers) != 1 or arrays[0].depends or "multipliers" in depends:
            return None
        table, x = jnp.asarray(arrays[0].value), numbers[0].value
        if not _is_float(x):
            return None
        n = table.shape[0]
        key = ("place", arrays[0].number, numbers[0].number)
        actual = jnp.sum(table <= x).astype(x.dtype)
        slot = self._slot("a table", depends, False, True, ())
        mode = self._mode(key, slot, Timed(actual, x, None, "place", table))
        if mode is None:
            return None
        i = mode.astype(int)
        low, high = table[jnp.clip(i - 1, 0, n - 1)], table[jnp.clip(i, 0, n - 1)]
        width = table[-1] - table[0]
        low, high = jnp.where(i < 1, x - width, low), jnp.where(i >= n, x + width, high)
        up = x - low > high - x
        beyond = jnp.where(up, mode + 1, mode - 1)
        self.inside.setdefault(key, Inside((x - low) * (high - x), beyond, actual, x))
        # `interp` also compares with the ends of its table; after it the same comparison stands for itself.
        self._beyond_table = {numbers[0].number: (mode < 0.5, mode > n - 0.5)}
        dtype = equation.outvars[0].aval.dtype
        return [KnownValue(i.astype(dtype), self.table.number("place", *key), frozenset({OUTCOME}))]

    def _slot(self, kind: str, depends: frozenset, jumps: bool, levels: bool, shape: tuple[int, ...]) -> Slot:
        role = frozenset({self.role})
        return Slot(kind, depends, role if jumps else frozenset(), levels, role, shape)

    def _mode(self, key, slot: Slot, timed: Timed):
        """The mode; None for a jump in time alone, which stays as it is."""
        if slot.depends <= {"t", IN_TIME}:
            self.timed.setdefault(key, timed)
            return None
        known = self.table.slots.get(key, slot)
        self.table.slots[key] = known._replace(jumps=known.jumps | slot.jumps, roles=known.roles | slot.roles)
        return self.mode(key, timed.actual)


class _Held:
    """An array as a key, by its identity, and kept alive."""

    def __init__(self, value):
        self.value = value

    def __hash__(self):
        return id(self.value)

    def __eq__(self, other):
        return isinstance(other, _Held) and self.value is other.value


def _named_bodies(equation: JaxprEqn):
    for key, value in equation.params.items():
        yield from ((key, getattr(x, "jaxpr", x)) for x in (value if isinstance(value, tuple) else (value,))
                    if isinstance(x, ClosedJaxpr | Jaxpr))  # fmt: skip


def _called(equation: JaxprEqn):
    inner = stands_for(equation)
    names = [str(equation.params.get("name", ""))]
    if inner is not None:
        names += [str(e.params.get("name", "")) for e in inner.jaxpr.eqns]
    return next((name for name in names if name in WITH_KINKS), "")


def _is_only_a_scale(jaxpr: Jaxpr):
    # As in `logsumexp`, which subtracts the largest of its numbers and adds it again.
    return any(e.primitive.name == "stop_gradient" for e in jaxpr.eqns)


def _to_whole(equation: JaxprEqn):
    x, dtype = equation.invars[0].aval, equation.params["new_dtype"]
    return _is_float(x) and jnp.issubdtype(dtype, jnp.integer)


def _is_float(x):
    return jnp.issubdtype(x.dtype, jnp.floating)


def _in_words(name: str):
    words = {
        "scan": "a loop (scan)", "while": "a loop (while)", "cond": "lax.cond", "gt": "a comparison",
        "ge": "a comparison", "lt": "a comparison", "le": "a comparison", "reduce_max": "the largest of an array",
        "reduce_min": "the smallest of an array", "convert_element_type": "a conversion to whole numbers",
    }  # fmt: skip
    return words.get(name, name)
