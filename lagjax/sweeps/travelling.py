"""What of a sweep goes along when it is pickled: functions where pickle takes them, as bytes until they are called."""

import pickle
from collections.abc import Callable

import numpy as np
from jaxtyping import PyTree

from lagjax.sweeps.fingerprint import named_leaves

# What pickle raises for functions that it cannot find by their name, and for what is no data.
NOT_PICKLED = (pickle.PicklingError, AttributeError, TypeError)


def pickled(run: Callable) -> bytes | None:
    """A function for another process; None where it has no name there."""
    try:
        return pickle.dumps(run)
    except NOT_PICKLED:
        return None


def unpickled(run: bytes | None, name: str) -> Callable:
    """The function again.

    **Raises:** `ValueError` where it did not come along, or is not found here.
    """
    if run is None:
        raise ValueError(
            f"what ran this sweep, {name}, could not be pickled and stayed where it was.\n"
            "Usual cause: a lambda, or a function inside of another one.\n"
            "Fix: swept.resweep(run), with the function; or define it with def at the top of a module."
        )
    try:
        return pickle.loads(run)
    except (AttributeError, ImportError) as error:
        raise ValueError(
            f"what ran this sweep, {name}, is not found here: {error}.\n"
            "Usual cause: it was defined in a notebook, or in the script that was run.\n"
            "Fix: swept.resweep(run), with the function."
        ) from error


def shapes_of(values: PyTree, lead: int) -> str:
    """The values of a point, as a person writes them; the first `lead` dimensions are those of the sweep."""
    of_one = lambda x: f"{x.dtype}{list(np.shape(x)[lead:]) or ''}"
    return ", ".join(sorted(f"{name} {of_one(x)}" for name, x in named_leaves(values)))
