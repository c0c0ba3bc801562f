"""Trajectories read from files, with the system that the user passes again, if it is the same."""

import os

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax.mechanics import files
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.hybrid import Hybrid
from lagjax.mechanics.signature import UnknownSystem, differences, signature
from lagjax.mechanics.system import System
from lagjax.mechanics.written_trees import Reader
from lagjax.motion.accuracy import Errors
from lagjax.motion.crossings import Crossings
from lagjax.motion.hybrid_trajectory import HybridTrajectory, Switches
from lagjax.motion.results import RESULTS, item
from lagjax.motion.saving import PLAIN
from lagjax.motion.switching import traced_phases
from lagjax.motion.trajectory import Asked, How, Snapshot, Trajectory, pack


def load_trajectory(path: str | os.PathLike, system: System | Hybrid | None = None) -> Trajectory:
    """Read a trajectory that `traj.save(path)` has written, bit for bit.

    >>> import os
    >>> import tempfile
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> traj = lj.integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=[0.0, 0.2, 0.5])
    >>> path = os.path.join(tempfile.mkdtemp(), "fall.npz")
    >>> traj.save(path)
    >>> again = lj.load_trajectory(path, fall)
    >>> print(again.q.round(9), again.params["g"], again.at(0.1).q.round(9))
    [0.   0.4  0.25] 10.0 0.25

    **Arguments:**

    - `path`: the file.
    - `system`: the `System` or `Hybrid` that was integrated, whose functions are not in the file. It is needed for what
      calls them: `at`, `drift()`, `residual()`, `jacobi_integral()`, `lj.energy_ledger(traj)`. Without it all computed
      values are available, and these methods say what is missing.

    **Returns:** the `Trajectory`, or `HybridTrajectory`. Named tuples of a class that has not been imported come back
    as named tuples of another class with the same fields.

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError` for a file that is damaged, does not hold a trajectory, or is from a newer lagjax; for a `system`
      other than the integrated one, as told by the values of its functions at a state in the middle of the motion; for
      a file in float64 if JAX works in float32; and for objects of a class that has not been imported.
    """
    said, arrays = files.read(path, "trajectory")
    reader = Reader(arrays)
    try:
        found = {name: reader.up(node) for name, node in said["trajectory"].items()}
        known = UnknownSystem(**found["system"])
        trajectory = trajectory_of(found, known)
    except (KeyError, TypeError, IndexError, StopIteration) as error:
        files.raise_damaged(path, f"its description is incomplete ({error})", error)
    except ValueError as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    return trajectory if system is None else trajectory_of(found, same_system(system, known, path))


def trajectory_of(found: dict, kept: System | Hybrid | UnknownSystem) -> Trajectory:
    """The trajectory with these parts (see `saving.parts`) and the system `kept`."""
    fields = {name: found[name] for name in PLAIN}
    fields |= {"end": Snapshot(**found["end"]), "result": result_of_names(found["result"])}
    fields["events"] = {name: Crossings(**x) for name, x in found["events"].items()}
    error = found["error"]
    fields["error"] = None if error is None else Errors(**error | {"result": result_of_names(error["result"])})
    fields["arrays"], fields["static"] = pack(kept, found["params"], Asked(**found["asked"]), How(**found["how"]))
    if "phase" not in found:
        return Trajectory(**fields)
    return HybridTrajectory(**fields, phase=found["phase"], switches=_made(Switches, found["switches"]))


def same_system(system, known: UnknownSystem, path) -> System | Hybrid:
    """Return the integrated system, which the user passes again; raise if it is another one."""
    check_same(system, known, path)
    return system


def check_same(system, known: UnknownSystem, path) -> None:
    """Raise if a system is not the one that a file describes."""
    if not isinstance(system, (System, Hybrid)):
        raise TypeError(
            f"system must be a lj.System, not {type(system).__name__}.\nFix: lj.load_trajectory(path, system=system)."
        )
    if known.state is None:
        return
    try:
        state = State(*known.state)
        here = signature(traced_phases(system, state), state)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise ValueError(
            f"this system is not the one of {path} ({known.words.splitlines()[0]}): it cannot be evaluated at a state "
            f"of that motion.\nIts error: {error}"
        ) from error
    if found := differences(known.signature, here):
        lines = "".join(f"    {line}\n" for line in found)
        raise ValueError(
            f"this system is not the one of {path} ({known.words.splitlines()[0]}):\n{lines}"
            "Usual cause: a function that has changed since, or another file.\n"
            "Fix: pass the system that was integrated; or leave system out, and read the computed values alone."
        )


def _made(cls, fields):
    """A module with these fields."""
    found = object.__new__(cls)
    for name, x in fields.items():
        object.__setattr__(found, name, x)
    return found


def result_of_names(said) -> RESULTS:
    """The results whose names were written."""
    codes, now = said["codes"], np.asarray(said["codes"]).copy()
    for code, name in said["names"].items():
        if name not in RESULTS._name_to_item:
            raise ValueError(f"the result '{name}' is not known to this version of lagjax.")
        now[np.asarray(codes) == int(code)] = int(RESULTS._name_to_item[name]._value)
    now = jnp.asarray(now) if isinstance(codes, jax.Array) else now
    return eqx.tree_at(lambda r: r._value, item(RESULTS.successful, 0), now)
