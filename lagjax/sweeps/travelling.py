"""Functions in the pickle of a sweep: included if pickle can find them, and kept as bytes until they are called."""

import pickle
from collections.abc import Callable

import numpy as np
from jaxtyping import PyTree

from lagjax.sweeps.fingerprint import named_leaves

# The exceptions of pickle for functions that it cannot find by name, and for objects that are not data.
NOT_PICKLED = (pickle.PicklingError, AttributeError, TypeError)


def pickled(run: Callable) -> bytes | None:
    """A function as bytes for another process; None if it cannot be pickled."""
    try:
        return pickle.dumps(run)
    except NOT_PICKLED:
        return None


def unpickled(run: bytes | None, name: str) -> Callable:
    """The function, restored.

    **Raises:** `ValueError` if it was not pickled, or is not found here.
    """
    if run is None:
        raise ValueError(
            f"the function that ran this sweep, {name}, could not be pickled.\n"
            "Usual cause: a lambda, or a function defined inside another one.\n"
            "Fix: swept.resweep(run), with the function; or define it with def at the top of a module."
        )
    try:
        return pickle.loads(run)
    except (AttributeError, ImportError) as error:
        raise ValueError(
            f"the function that ran this sweep, {name}, is not found here: {error}.\n"
            "Usual cause: it was defined in a notebook, or in the script that was run.\n"
            "Fix: swept.resweep(run), with the function."
        ) from error


def shapes_of(values: PyTree, lead: int) -> str:
    """The names and shapes of a point's values as text; the first `lead` dimensions are those of the sweep."""
    of_one = lambda x: f"{x.dtype}{list(np.shape(x)[lead:]) or ''}"
    return ", ".join(sorted(f"{name} {of_one(x)}" for name, x in named_leaves(values)))
