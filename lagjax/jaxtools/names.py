"""Names that stand for programs, and what is known of programs without running them.

A sweep is known by the jaxpr of its function. Where names are given, what is `compiled` and a motion are one equation
in there, with the digest of what they mean; the kinds of their results are in the folder of programs. Such a jaxpr is
never run: it is the key to a program. Derivatives and lanes of what has a name are further names.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.tree_util as jtu
from jax.extend.core import ClosedJaxpr
from jax.interpreters import ad
from jaxtyping import PyTree

from lagjax.contexts import NAMING
from lagjax.jaxtools import folder
from lagjax.jaxtools.cache import FACTS
from lagjax.jaxtools.digest import NotKept, digest_of, surroundings
from lagjax.jaxtools.kept import Said, as_data, kept_here, kind, kinds_from, outline_of
from lagjax.jaxtools.outline import NoOutline
from lagjax.jaxtools.primitives import front, is_float, no_tangent, primitive
from lagjax.jaxtools.tracing import HAPPENED


def surroundings_for_names() -> bytes | None:
    """The value of `NAMING` for a program that is to be known by names; None where nothing is kept."""
    try:
        kept_here([])
        return surroundings() if folder.place().path is not None else None
    except NotKept:
        return None


class Traced(NamedTuple):
    """A traced program, and the structure of its results; `happened`: what happened meanwhile (`HAPPENED`)."""

    program: ClosedJaxpr
    structure: Any
    happened: Counter[str]


def traced(function: Callable[[list], PyTree], kinds: Iterable[tuple]) -> Traced:
    """The program of a function of a list of arrays of these kinds."""
    before = HAPPENED.copy()
    like = [jax.ShapeDtypeStruct(shape, dtype, weak_type=weak) for shape, dtype, weak in kinds]
    with NAMING(None):
        program, shapes = jax.make_jaxpr(function, return_shape=True)(like)
    return Traced(program, jtu.tree_structure(shapes), HAPPENED - before)


def named(function: Callable[[list], PyTree], said: Said, arrays: list) -> PyTree | None:
    """Results that stand for `function(arrays)`; None where no names are given, or this has none."""
    here = NAMING.value
    if here is None:
        return None
    where = folder.place()
    if where.path is None:
        return None
    try:
        digest = _digest(said, arrays, here)
        trace = partial(traced, function, map(kind, arrays))
        structure, outputs = FACTS.made((named, digest), lambda: _found(trace, said, arrays, where.path, digest))
    except (NotKept, NoOutline):
        return None
    return jtu.tree_unflatten(structure, named_p.bind(*arrays, of=digest, outputs=outputs))


def results_of(trace: Callable[[], Traced], said: Said, arrays: list) -> tuple[Any, tuple]:
    """The structure and the kinds of a program's results: kept ones, or from its trace."""
    where = folder.place()
    try:
        if where.path is None:
            raise NotKept(where.why_not)
        return _found(trace, said, arrays, where.path, _digest(said, arrays))
    except (NotKept, NoOutline):
        traced = trace()
        return traced.structure, _said_of(traced.program.out_avals)


def _digest(said: Said, arrays: list, around: bytes | None = None) -> str:
    return digest_of([((kept_here(arrays), *map(kind, arrays), "named"), False), *said.parts()], around)


def _found(trace: Callable[[], Traced], said: Said, arrays: list, path: Any, digest: str) -> tuple[Any, tuple]:
    """The structure and the kinds of results; what was traced is kept."""
    entry = folder.read(path, digest)
    if entry is not None:
        header, _ = entry
        return jtu.tree_structure(said.tree(header["outline"], arrays)), _said_of(kinds_from(header["outputs"]))
    traced = trace()
    leaves = traced.program.out_avals
    if not traced.happened:
        outline = outline_of(said, traced.structure, arrays)
        folder.write(path, digest, {"outline": outline, "outputs": [as_data(x) for x in leaves]}, b"")
    return traced.structure, _said_of(leaves)


def _said_of(outputs: Iterable) -> tuple:
    """Kinds of results, as a parameter of an equation that can be compared."""
    return tuple((x.shape, x.dtype.name, bool(x.weak_type)) for x in outputs)


def _never(*operands, **params):
    raise NotImplementedError("a name stands for a program, and is never run")


def _pushed(primals: Sequence, tangents: Sequence, *, of: Any, outputs: tuple):
    found = named_p.bind(*primals, of=of, outputs=outputs)
    moving = tuple(not isinstance(x, ad.Zero) for x in tangents)
    directions = [x for x, moves in zip(tangents, moving) if moves]
    floats = _said_of(x.to_tangent_aval() for x in kinds_from(outputs) if is_float(x))
    pushes = iter(pushed_p.bind(*primals, *directions, of=(of, moving), outputs=floats))
    return found, [next(pushes) if is_float(x) else no_tangent(x) for x in found]


def _pulled(cotangents: Sequence, *operands, of: Any, outputs: tuple):
    wanted = tuple(ad.is_undefined_primal(x) for x in operands)
    given = [x for x, w in zip(operands, wanted) if not w]
    kinds = _said_of(x.aval for x, w in zip(operands, wanted) if w)
    given += map(ad.instantiate_zeros, cotangents)
    found = iter(named_p.bind(*given, of=("pulled", of, wanted), outputs=kinds))
    return [next(found) if w else None for w in wanted]


def _in_lanes(operands: Sequence, axes: Sequence, *, of: Any, outputs: tuple, which: Callable):
    moved, batched, lanes = front(operands, axes)
    lanes_of = tuple(((lanes, *shape), *rest) for shape, *rest in outputs)
    return which().bind(*moved, of=("lanes", of, batched), outputs=lanes_of), [0] * len(outputs)


def _shapes(*operands, of: Any, outputs: tuple):
    return kinds_from(outputs)


def _primitive(name: str, **rules) -> Any:
    return primitive(name, _never, _shapes, several=True, **rules)


named_p = _primitive("lagjax_named", jvp=_pushed, batched=partial(_in_lanes, which=lambda: named_p))
pushed_p = _primitive("lagjax_named_push", transpose=_pulled, batched=partial(_in_lanes, which=lambda: pushed_p))
