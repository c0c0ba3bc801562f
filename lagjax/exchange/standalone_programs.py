"""A function that integrates, as a program that runs without lagjax.

What JAX compiles of it is a program in StableHLO, which needs nothing of the Python that made it; `jax.export` writes
such programs down. Three things of a motion stand in the way, and are taken out here:

- checks that raise an error at run time, for which the program calls Python: failures are told by codes and NaN;
- a `Trajectory`, whose class the other process does not have: it becomes a dictionary of its arrays;
- prints, callbacks and progress meters: these are refused.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import export as jax_export
from jaxtyping import PyTree

from lagjax.jax_internals.one_function import calls_host, poisoned
from lagjax.jax_internals.primitives import jaxpr_as_fun
from lagjax.jax_internals.tracing import SILENT
from lagjax.motion.results import RESULTS
from lagjax.motion.results import in_words as result_in_words
from lagjax.motion.trajectory import Trajectory

# What a process without lagjax can take and give.
PLAIN = (dict, list, tuple)
# An item of one of equinox's enumerations.
ITEM = type(RESULTS.successful)


def export(run: Callable, *examples: PyTree, platforms: Sequence[str] | None = None) -> jax_export.Exported:
    """Make of a function that integrates a program that runs without lagjax, by JAX alone.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> ts = jnp.array([0.0, 0.2, 0.5])
    >>> program = lj.export(lambda v0, params: lj.integrate(fall, 0.0, v0, params, ts=ts), 3.0, {"g": 10.0})
    >>> motion = program.call(3.0, {"g": 10.0})
    >>> print(motion["q"].round(9), lj.result_codes()[int(motion["result"])])
    [0.   0.4  0.25] successful

    **Arguments:**

    - `run`: any function that `jax.jit` takes, with motions in it or derivatives of them.
    - `examples`: its arguments, for their structures, shapes and dtypes: numbers, arrays, `jax.ShapeDtypeStruct`, in
      dictionaries, lists and tuples. All of them are arguments of the program; whole Python numbers are taken as
      floats. Shapes may be symbolic (`jax.export.symbolic_shape`), for a batch of any size under `jax.vmap`; the number
      of output times may not.
    - `platforms`: such as `("cpu", "cuda")`; by default the one that JAX uses here.

    **Returns:** a `jax.export.Exported`: `.serialize()` gives its bytes, and in another process
    `jax.export.deserialize(bytes).call(*arguments)` runs it. It takes arguments as `run` does and returns what `run`
    does, with dictionaries of arrays in place of trajectories and of whatever else has names. Nothing in it raises: a
    motion that fails is NaN from there on, and tells why by its "result", a number that `lj.result_codes()` explains. A
    check (`equinox.error_if`) gives NaN.

    **Raises:** `TypeError` for arguments or results that are no numbers, arrays, dictionaries, lists and tuples;
    `ValueError` for what calls Python while it runs.

    Source: https://docs.jax.dev/en/latest/export/export.html; `docs/taking-a-solve-elsewhere.md`.
    """
    if not callable(run):
        raise TypeError(
            f"lj.export takes a function, not {type(run).__name__}.\n"
            "Fix: lj.export(lambda params: lj.integrate(system, q0, v0, params, ts=ts), params)."
        )
    examples = jtu.tree_map(_as_argument, examples, is_leaf=lambda x: type(x) not in PLAIN)

    def program(*args):
        leaves, structure = jtu.tree_flatten(args)
        shape = []

        def of_leaves(*leaves):
            found, tree = jtu.tree_flatten(plain(run(*jtu.tree_unflatten(structure, leaves))))
            shape.append(tree)
            return [_as_result(x) for x in found]

        with SILENT(True):
            silent = poisoned(jax.make_jaxpr(of_leaves)(*leaves))
        if calls_host(silent.jaxpr) or silent.effects:
            raise ValueError(
                "the function calls Python while it runs, and a process without it could not.\n"
                "Usual cause: jax.debug.print, jax.debug.callback, jax.pure_callback, or progress=True.\n"
                "Fix: leave it out of what is exported."
            )
        return jtu.tree_unflatten(shape[0], jaxpr_as_fun(silent)(*leaves))

    # The name that the other process shows.
    program.__name__ = getattr(run, "__name__", "run")
    return jax_export.export(jax.jit(program), platforms=platforms)(*examples)


def result_codes() -> dict[int, str]:
    """What the numbers mean that an exported program gives as the "result" of a motion.

    >>> import lagjax as lj
    >>> lj.result_codes()[0]
    'successful'

    **Returns:** sentences by their numbers, those of this version of lagjax: write them down beside the program.

    **Raises:** nothing.
    """
    return {code: result_in_words(code) for code in range(len(RESULTS))}


def plain(tree: PyTree) -> PyTree:
    """Dictionaries, lists and tuples: what has named parts becomes a dictionary, a `RESULTS` item its code."""
    if isinstance(tree, ITEM):
        return tree._value
    if isinstance(tree, Mapping):
        return {name: plain(x) for name, x in tree.items()}
    if hasattr(tree, "_fields"):
        return {name: plain(x) for name, x in zip(tree._fields, tree)}
    if isinstance(tree, list | tuple):
        return type(tree)(map(plain, tree))
    if is_dataclass(tree) and not isinstance(tree, type):
        # The system and the parameters of a trajectory are not among what is known of the motion.
        names = [f.name for f in fields(tree) if not f.metadata.get("static", False)]
        names = [name for name in names if not (isinstance(tree, Trajectory) and name == "arrays")]
        return {name: plain(getattr(tree, name)) for name in names}
    return tree


def _as_argument(x):
    """An example as the program takes it."""
    if isinstance(x, int) and not isinstance(x, bool):
        return float(x)
    if isinstance(x, bool | float | complex | np.ndarray | np.generic | jax.Array | jax.ShapeDtypeStruct):
        return x
    raise TypeError(
        f"an argument of an exported program is a number or an array, in dictionaries, lists and tuples, and not "
        f"{type(x).__name__}: the other process does not know what that is.\n"
        "Usual cause: a named tuple, a class, a system or a function among the examples.\n"
        'Fix: {"x": 1.0, "y": 0.0} in place of a class; close over what is no number: lj.export(lambda q0: ..., q0).'
    )


def _as_result(x):
    if isinstance(x, bool | int | float | complex | np.ndarray | np.generic | jax.Array):
        return jnp.asarray(x)
    raise TypeError(
        f"an exported program gives numbers and arrays, and the function returned {x!r:.60}, a {type(x).__name__}.\n"
        "Fix: return what is wanted of it, as traj.q and traj.result."
    )
