"""Export a function that integrates as a program that runs without lagjax.

JAX compiles the function to a StableHLO program, which does not need the Python code that made it; `jax.export` writes
such programs to bytes. Three parts of a motion prevent this, and are removed here:

- checks that raise an error at run time, for which the program calls Python: failures become codes and NaN instead;
- a `Trajectory`, whose class the other process does not have: it becomes a dictionary of its arrays;
- prints, callbacks and progress meters: these are refused.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jax import export as jax_export
from jaxtyping import PyTree

from lagjax.integrate import RESULTS, Trajectory
from lagjax.integrate import in_words as result_in_words
from lagjax.jaxtools import SILENT, calls_host, jaxpr_as_fun, poisoned

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
    `ValueError` for functions that call Python while they run.

    Source: https://docs.jax.dev/en/latest/export/export.html; `docs/taking-a-solve-elsewhere.md`.
    """
    if not callable(run):
        raise TypeError(
            f"lj.export takes a function, not {type(run).__name__}.\n"
            "Fix: lj.export(lambda params: lj.integrate(system, q0, v0, params, ts=ts), params)."
        )
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
