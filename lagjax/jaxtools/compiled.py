"""Programs that Python calls, compiled and kept; inside another program, parts of it, or names.

A sweep is known by the jaxpr of its function. Where names are given, what is `compiled` and a motion are one equation
in there, with the digest of what they mean; the kinds of their results are in the folder of programs. Such a jaxpr is
never run: it is the key to a program. Derivatives and lanes of what has a name are further names.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import partial, wraps
from typing import Any

import jax
import jax.tree_util as jtu
import numpy as np
from jax.interpreters import ad
from jaxtyping import PyTree

from lagjax.jaxtools import folder
from lagjax.jaxtools.cache import FACTS, HashablePart, compiler_options, hashable_partition, program_of
from lagjax.jaxtools.digest import NotKept, digest_of, surroundings
from lagjax.jaxtools.kept import KeptProgram, Said, as_data, kept_here, kind, kinds_from, outline_of
from lagjax.jaxtools.outline import NoOutline, outlined, parts_of, rebuilt
from lagjax.jaxtools.primitives import front, is_float, jitted, no_tangent, one_by_one, primitive
from lagjax.jaxtools.tracing import HAPPENED, as_usual, is_eager, is_traced

# Where names are given: the digest of what surrounds the whole program. A JAX context.
NAMING = jax.make_user_context(default_value=None)


def compiled(function: Callable, in_numpy: bool = False) -> Callable:
    """Compile `function` for the structure and shapes of its pytrees; inside another program it becomes part of that.

    Its programs are kept. With `in_numpy`, a call from Python returns NumPy arrays.
    """
    as_part = jitted(function)
    finish = partial(jtu.tree_map, np.asarray) if in_numpy else jax.block_until_ready

    @wraps(function)
    @as_usual
    def program(*args):
        arrays, static = hashable_partition(args)
        if not is_eager() or is_traced(args):
            found = named(partial(_of_arrays, function, static), _said(function, static), arrays)
            return as_part(*args) if found is None else found
        try:
            return finish(program_of((function, static), lambda: _program(function, static))(arrays))
        except jax.errors.JaxRuntimeError:
            # Equinox's wrapper has a better message for the checks that equinox puts into a program.
            return finish(as_part(*args))

    return program


def _program(function: Callable, static: HashablePart) -> KeptProgram:
    return KeptProgram(partial(_of_arrays, function, static), _said(function, static), compiler_options())


def _said(function: Callable, static: HashablePart) -> Said:
    def outline(results: PyTree):
        return outlined(results, parts_of(static.combine(range(len(static.leaves)))))

    def tree(outline: Any, arrays: list):
        return rebuilt(outline, parts_of(static.combine(arrays)))

    def meant():
        return [((function, compiler_options()), False), (static, False)]

    return Said(meant, outline, tree)


def _of_arrays(function: Callable, static: HashablePart, arrays: Sequence):
    return one_by_one(function)(*static.combine(arrays))


def surroundings_for_names() -> bytes | None:
    """The value of `NAMING` for a program that is to be known by names; None where nothing is kept."""
    try:
        kept_here([])
        return surroundings() if folder.place().path is not None else None
    except NotKept:
        return None


def named(function: Callable[[list], PyTree], said: Said, arrays: list) -> PyTree | None:
    """Results that stand for `function(arrays)`; None where no names are given, or this has none."""
    here = NAMING.value
    if here is None:
        return None
    where = folder.place()
    if where.path is None:
        return None
    try:
        digest = digest_of([((kept_here(arrays), *map(kind, arrays), "named"), False), *said.parts()], here)
        structure, outputs = FACTS.made((named, digest), lambda: _found(function, said, arrays, where.path, digest))
    except (NotKept, NoOutline):
        return None
    return jtu.tree_unflatten(structure, named_p.bind(*arrays, of=digest, outputs=outputs))


def _found(function: Callable, said: Said, arrays: list, path: Any, digest: str) -> tuple[Any, tuple]:
    """The structure and the kinds of the results: kept ones, or from a trace."""
    entry = folder.read(path, digest)
    if entry is not None:
        header, _ = entry
        return jtu.tree_structure(said.tree(header["outline"], arrays)), _said_of(kinds_from(header["outputs"]))
    before = HAPPENED.copy()
    with NAMING(None):
        program, shapes = jax.make_jaxpr(function, return_shape=True)([_shaped(x) for x in arrays])
    leaves, structure = program.out_avals, jtu.tree_structure(shapes)
    if HAPPENED == before:
        outline = outline_of(said, structure, arrays)
        folder.write(path, digest, {"outline": outline, "outputs": [as_data(x) for x in leaves]}, b"")
    return structure, _said_of(leaves)


def _shaped(x: Any):
    shape, dtype, weak = kind(x)
    return jax.ShapeDtypeStruct(shape, dtype, weak_type=weak)


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
