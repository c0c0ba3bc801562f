"""SymPy expressions as the source text of JAX functions.

A `System` from SymPy contains this text: it can be read, compared, copied and pickled, and Python compiles it at its
first call. Common subexpressions are computed once. Integer powers stay integers: JAX computes them, and their
derivatives, by products.

A `Piecewise` becomes `jnp.where`, which computes every branch. JAX's reverse mode multiplies the slope of a branch that
is not taken by zero, and zero times an infinite slope or NaN is NaN: for example (-x)**1.5 for x < 0, 0 for x > 0.
So functions without a slope at some numbers (roots, fractions, logarithms, inverse functions) get a harmless argument
in branches that are not taken.
"""

import keyword
import re
from collections.abc import Mapping, Sequence
from functools import lru_cache
from itertools import count
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp

# JAX's functions by SymPy's names, including those of two arguments.
FUNCTIONS = {
    **{name: f"jnp.{name}" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "log", "sign", "floor")},
    **{f"a{name}": f"jnp.arc{name}" for name in ("sin", "cos", "tan", "tan2", "sinh", "cosh", "tanh")},
    **{"Abs": "jnp.abs", "ceiling": "jnp.ceil", "Mod": "jnp.mod", "Heaviside": "jnp.heaviside", "hypot": "jnp.hypot"},
    **{name: f"jnp.{name}" for name in ("exp2", "expm1", "log1p", "log2", "log10")},
    **{"erf": "jax.scipy.special.erf", "erfc": "jax.scipy.special.erfc", "gamma": "jax.scipy.special.gamma"},
    **{"loggamma": "jax.scipy.special.gammaln", "digamma": "jax.scipy.special.digamma"},
}  # fmt: skip
# Functions without a value or a slope at some numbers, but with both at one half.
DELICATE = ("log", "asin", "acos", "atanh", "log2", "log10", "log1p", "gamma", "loggamma", "digamma")
# Larger integers are written as floats, since JAX's integers may have 32 bits.
WHOLE = 2**31 - 1
RESERVED = {"t", "q", "v", "params", "jax", "jnp", "multipliers"}


def sympy_itself(user: str = "lj.from_sympy") -> Any:
    """Import SymPy, or say how to get it; `user` is the function that needs it."""
    try:
        import sympy
    except ImportError as error:
        raise ImportError(f"{user} needs SymPy.\nFix: pip install 'lagjax[sympy]'.") from error
    return sympy


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


@lru_cache(maxsize=1024)
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
    kinds = [sympy.Add, sympy.Mul, sympy.Pow, sympy.Symbol, sympy.Number, sympy.NumberSymbol, sympy.sinc, sympy.frac]
    kinds += [sympy.Piecewise, sympy.functions.elementary.piecewise.ExprCondPair, sympy.ITE, sympy.Max, sympy.Min]
    kinds += [sympy.And, sympy.Or, sympy.Not, sympy.core.relational.Relational, sympy.logic.boolalg.BooleanAtom]
    for part in sympy.preorder_traversal(expression):
        # SymPy counts `nan` and `zoo` as numbers.
        known = isinstance(part, tuple(kinds)) and part not in (sympy.nan, sympy.zoo)
        undefined = isinstance(part, sympy.core.function.AppliedUndef)
        if not known and (undefined or type(part).__name__ not in FUNCTIONS):
            raise NotInJax(type(part).__name__ if part.args and not part.is_Atom else str(part))
    return expression


@lru_cache(maxsize=1)
def _printer():
    """SymPy's Python printer, which sets parentheses, with JAX's names for functions and numbers."""
    from sympy.printing.pycode import PythonCodePrinter

    sympy, of_python = sympy_itself(), cast(Any, PythonCodePrinter)

    class Printer(of_python):
        def _of_function(self, expr):
            return f"{FUNCTIONS[type(expr).__name__]}({', '.join(map(self._print, expr.args))})"

        def _print_Integer(self, expr):
            return repr(int(expr)) if abs(expr) <= WHOLE else repr(float(expr))

        def _print_Float(self, expr):
            return repr(float(expr))

        def _print_Rational(self, expr):
            return f"{self._print(expr.numerator)}/{self._print(expr.denominator)}"

        def _print_Pow(self, expr, rational=False):
            return self._hprint_Pow(expr, rational=rational, sqrt="jnp.sqrt")

        def _print_Piecewise(self, expr):
            (value, condition), *others = expr.args
            if condition == sympy.true:
                return self._print(value)
            # If no condition holds, the value is undefined.
            other = self._print(expr.func(*others, evaluate=False)) if others else "jnp.nan"
            return f"jnp.where({self._print(condition)}, {self._print(value)}, {other})"

        def _print_Relational(self, expr):
            return f"({self._print(expr.lhs)} {expr.rel_op} {self._print(expr.rhs)})"

        def _nested(self, function, args):
            first, *others = map(self._print, args)
            for other in others:
                first = f"{function}({first}, {other})"
            return first

        _print_Exp1 = _print_Pi = _print_NumberSymbol = _print_Float
        _print_EulerGamma = _print_GoldenRatio = _print_Catalan = _print_Float
        _print_Max = lambda self, expr: self._nested("jnp.maximum", expr.args)
        _print_Min = lambda self, expr: self._nested("jnp.minimum", expr.args)
        _print_And = lambda self, expr: self._nested("jnp.logical_and", expr.args)
        _print_Or = lambda self, expr: self._nested("jnp.logical_or", expr.args)
        _print_Not = lambda self, expr: f"jnp.logical_not({self._print(expr.args[0])})"
        _print_BooleanTrue = lambda self, expr: "True"
        _print_BooleanFalse = lambda self, expr: "False"
        _print_Infinity = lambda self, expr: "jnp.inf"
        _print_NegativeInfinity = lambda self, expr: "(-jnp.inf)"
        _print_sinc = lambda self, expr: f"jnp.sinc({self._print(expr.args[0] / sympy.pi)})"

        # The only undefined function left is `harmless`.
        _print_AppliedUndef = lambda self, expr: "jnp.where({1}, {0}, 0.5)".format(*map(self._print, expr.args))
        _print_frac = lambda self, expr: f"jnp.mod({self._print(expr.args[0])}, 1)"

    for name in FUNCTIONS:
        setattr(Printer, f"_print_{name}", Printer._of_function)
    return Printer()
