"""Read fits from files, with the functions that the user passes again."""

import os
from collections.abc import Callable
from typing import Any

import numpy as np

from lagjax.fitting.result import Fit
from lagjax.fitting.starts import unflatten_of
from lagjax.mechanics import files
from lagjax.mechanics.hybrid import Hybrid, first_phase, replace_fields
from lagjax.mechanics.memory import kinds
from lagjax.mechanics.signature import UnknownSystem
from lagjax.mechanics.system import System
from lagjax.mechanics.written_trees import NotGiven, Reader
from lagjax.motion.saved import same_system


def load_fit(
    path: str | os.PathLike, system: System | Hybrid | None = None, observe: Callable | None = None, **options
) -> Fit:
    """Read a fit that `found.save(path)` has written, bit for bit.

    >>> import os
    >>> import tempfile
    >>> import numpy as np
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> t = np.linspace(0.0, 1.0, 6)
    >>> found = lj.fit(fall, lj.Record(t, q=3.0 * t - 5.0 * t**2 + 1e-3 * np.cos(9.0 * t), sigma=1e-3), {"g": 9.0})
    >>> path = os.path.join(tempfile.mkdtemp(), "fall.npz")
    >>> found.save(path)
    >>> again = lj.load_fit(path, fall)
    >>> print(again.names, bool(again.sd == found.sd), again.motion().q.shape)
    ('g',) True (6,)

    **Arguments:**

    - `path`: the file.
    - `system`, `observe`: the fitted system and function, which are not in the file; `options`: those of `lj.fit` that
      contain functions, such as `events=`. `motion()`, `log_likelihood` and `laplace()` need them; without them these
      raise an error that names what is missing, and the estimates, their uncertainties and the residuals are available.

    **Returns:** the `Fit`.

    **Raises:**

    - `FileNotFoundError` if the file does not exist.
    - `ValueError` for a file that is damaged, holds something else, or was written by a newer lagjax or a version that
      stores fits in another form; for a `system` other than the fitted one; for a float64 file while JAX works in
      float32.
    - `TypeError` for functions that the fit did not have.
    """
    contents, arrays = files.read(path, "fit")
    known = {"system": system, "observe": observe} | {f"options.{name}": x for name, x in options.items()}
    known = {role: x for role, x in known.items() if x is not None}
    if unknown := sorted(set(known) - set(contents["functions"])):
        raise TypeError(
            f"this fit has no {', '.join(_short(role) for role in unknown)} to be passed again.\n"
            f"It has {', '.join(_short(role) for role in contents['functions'])}."
        )
    try:
        placeholder: Any = UnknownSystem(**Reader(arrays).up(contents["known"]))
        if system is not None:
            alike = same_system(system, placeholder, path)
            phase = placeholder.phase
            placeholder = alike if phase is None else replace_fields(alike, first=np.asarray(phase, np.int32))
        like = Reader(arrays).up(contents["q"])
        known |= {"system": placeholder, "unflatten": unflatten_of(kinds(like))}
        known["first"] = placeholder if system is None else first_phase(placeholder)
        return Reader(arrays, lambda role: known[role] if role in known else NotGiven(_short(role))).up(contents["fit"])
    except (KeyError, AttributeError, TypeError, IndexError, StopIteration) as error:
        if isinstance(error, TypeError) and "lj.System" in str(error):
            raise
        files.raise_damaged(path, f"its description is incomplete ({error})", error)


def _short(role):
    return role.removeprefix("options.")
