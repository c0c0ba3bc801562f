"""Trajectories read from files, with the system that the user passes again, if it is the same."""

import os
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from lagjax.files import Reader, Table, check_field, fields_of, npz
from lagjax.integrate.data import PLAIN
from lagjax.integrate.events.event import Crossings
from lagjax.integrate.results import RESULTS, Errors, Snapshot, SolveInfo, SolveOptions, item, pack
from lagjax.integrate.solve.phases import backward_trajectory_of, traced_phases
from lagjax.integrate.solve.programs import trajectory_of
from lagjax.integrate.trajectory import OF_PHASES, HybridTrajectory, Switches, Trajectory
from lagjax.jaxtools import is_array, without_init
from lagjax.refusals import must_be
from lagjax.system import SYSTEMS, Hybrid, State, System, UnknownSystem, differences, signature


def load_trajectory(
    path: str | os.PathLike, system: System | Hybrid | None = None, *, classes: Iterable[type] = ()
) -> Trajectory:
    """Read a trajectory that `traj.save(path)` has written, bit for bit.

    A file is data: reading it imports nothing, runs nothing of it and writes nothing, whoever has written it.

    >>> import os
    >>> import tempfile
    >>> import lagjax as lj
    >>> fall = lj.System(lambda t, q, v, params: 0.5 * v**2 - params["g"] * q)
    >>> traj = lj.integrate(fall, 0.0, 3.0, {"g": 10.0}, ts=[0.0, 0.2, 0.5])
    >>> path = os.path.join(tempfile.mkdtemp(), "fall.npz")
    >>> traj.save(path)
    >>> again = lj.load_trajectory(path, fall)
    >>> print(again.q.round(9), again.params["g"], again.at([0.1, 0.3]).q.round(9))
    [0.   0.4  0.25] 10.0 [0.25 0.45]

    **Arguments:**

    - `path`: the file.
    - `system`: the `System` or `Hybrid` that was integrated, whose functions are not in the file. It is needed for what
      calls them: `at`, `drift()`, `residual()`, `jacobi_integral()`, `lj.energy_ledger(traj)`. Without it all computed
      values are available, and these methods say what is missing.
    - `classes`: your own classes of which it holds objects (named tuples, dataclasses, modules of equinox):
      `classes=[Pair]`. Those of lagjax, and the methods and layers of diffrax and equinox, are known.

    **Returns:** the `Trajectory`, or `HybridTrajectory`.

    **Raises:**

    - `FileNotFoundError` if there is no such file.
    - `ValueError` for a file that is damaged, does not hold a trajectory, or is from a newer lagjax; for a `system`
      other than the integrated one, as told by the values of its functions at a state in the middle of the motion; for
      a file in float64 if JAX works in float32; and for objects of a class that was not passed.
    """
    table = Table(classes)
    with npz.opened(path, "trajectory") as (said, array):
        reader = Reader(array, table=table)
        found = {name: reader.up(node) for name, node in said["trajectory"].items()}
        known = described_system(found["system"])
        check_shapes(found)
        trajectory = trajectory_from(found, known)
    return trajectory if system is None else trajectory_from(found, same_system(system, known, path))


# What is counted of every motion.
COUNTS = "num_steps", "num_accepted_steps", "num_rejected_steps"


def described_system(said: dict[str, Any]) -> UnknownSystem:
    """What a file knows about a system.

    **Raises:** `ValueError`, or what Python raises, if it is not as lagjax writes it.
    """
    known = UnknownSystem(**said)
    one_row = all(isinstance(x, np.ndarray) and x.ndim == 1 and x.dtype.kind == "f" for x in known.signature.values())
    in_words = (known.words, *known.signature, *map(str, known.angles))
    if not one_row or not all(isinstance(x, str) for x in in_words) or {*map(type, known.angles)} - {bool}:
        raise ValueError("its description of the system is not one that lagjax writes.")
    if known.state is not None:
        State(*known.state)
    if known.phase is not None:
        known.phase.bit_length()
    return known


def check_shapes(found: dict[str, Any]) -> None:
    """Raise `ValueError` if the numbers of a trajectory do not belong together."""
    t, outputs = found["t"], found["t"].shape
    batch = outputs[:-1]

    def check(name: str, leaves: Sequence, lead, kinds="f", exactly=False):
        for x in leaves if isinstance(leaves, list) else jax.tree.leaves(leaves):
            shape = np.shape(x) if exactly else np.shape(x)[: len(lead)]
            if not isinstance(x, (jax.Array, np.ndarray, np.generic)) or shape != lead or x.dtype.kind not in kinds:
                raise ValueError(f"{name} does not belong to times of shape {outputs}.")

    def check_states(name: str, said: dict[str, Any], lead):
        check(name, [said["t"]], lead, exactly=True)
        check(name, (said["q"], said["v"]), lead)
        check(name, list(said["multipliers"].values()), lead)
        if jax.tree.structure(said["q"]) != jax.tree.structure(said["v"]) or not jax.tree.leaves(said["q"]):
            raise ValueError(f"{name} has no coordinates, or velocities in another structure.")

    def of_rows(said: dict[str, Any]):
        # The crossings or switches of each lane: their number is free.
        return (*batch, said["t"].shape[len(batch)])

    if t.ndim == 0:
        raise ValueError("its times are one number.")
    check_states("the motion", found, outputs)
    check_states("the end", found["end"], batch)
    check("stats", [found["stats"][name] for name in COUNTS], batch, "iu", exactly=True)
    check("scaled_error", [found["scaled_error"]], batch, exactly=True)
    rtol, atol = found["tolerance"]
    check("tolerance", [rtol, atol], (*batch, 2))
    if max(rtol.ndim, atol.ndim) > len(batch) + 2 or not isinstance(found["tolerance"], tuple):
        raise ValueError("its tolerances are not two rows of numbers.")
    check("result", [found["result"]["codes"]], batch, "iu", exactly=True)
    for name, crossings in found["events"].items():
        check_states(f"event {name}", crossings, of_rows(crossings))
        check(f"event {name}", [crossings["count"]], batch, "iu", exactly=True)
        check(f"event {name}", [crossings["uncertain"]], batch, "b", exactly=True)
    if (error := found["error"]) is not None:
        check("error", (error["q"], error["v"]), outputs)
        check("error", list(error["multipliers"].values()), outputs)
        check("error of events", list(error["events"].values()), batch)
        check("error", [error["result"]["codes"], error["steps"]], batch, "iu", exactly=True)
    if "phase" in found:
        switches = found["switches"]
        rows = of_rows(switches)
        check("phase", [found["phase"]], outputs, "iu", exactly=True)
        check("switches", [switches["t"]], rows, exactly=True)
        check("switches", [switches["way"], switches["to"]], rows, "iu", exactly=True)
        check("switches", tuple(switches[name] for name in ("q", "v", "q_after", "v_after", "impulse")), rows)
        check("switches", [switches["count"]], batch, "iu", exactly=True)
        check("switches", [switches["uncertain"]], batch, "b", exactly=True)
        if (modes := found.get("modes")) is not None:
            # Files older than elements in phases have no kinds of switches.
            many = len(switches["ways"]) - list(switches.get("kinds", ())).count(OF_PHASES)
            check("modes", [modes], (*outputs, many), "iu", exactly=True)
            check("switches", [switches["modes"]], (*rows, many), "iu", exactly=True)
        if not all(isinstance(x, str) for x in (*switches["names"], *switches["ways"])):
            raise ValueError("its phases have no names.")


def trajectory_from(found: dict, kept: System | Hybrid | UnknownSystem) -> Trajectory:
    """The trajectory with these parts (see `save.parts`) and the system `kept`."""
    fields = {name: found[name] for name in PLAIN}
    fields |= {"end": Snapshot(**found["end"]), "result": result_of_names(found["result"])}
    fields["events"] = {name: made(Crossings, x) for name, x in found["events"].items()}
    error = found["error"]
    fields["error"] = None if error is None else Errors(**error | {"result": result_of_names(error["result"])})
    asked, how = made(SolveOptions, found["asked"]), made(SolveInfo, found["how"])
    if isinstance(kept, SYSTEMS):
        # As `vmap` leaves it, so that a lane of a batch has its system.
        batch = np.shape(found["t"])[:-1]
        kept = jax.tree.map(lambda x: jnp.broadcast_to(x, (*batch, *x.shape)) if batch and is_array(x) else x, kept)
    integrate = backward_trajectory_of if how.backward else trajectory_of
    fields["arrays"], fields["static"] = pack((kept, found["params"], asked), how, integrate)
    if "phase" not in found:
        return Trajectory(**fields)
    # Older files have no modes.
    modes, switches = found.get("modes"), made(Switches, found["switches"])
    return HybridTrajectory(**fields, phase=found["phase"], switches=switches, modes=modes)


def check_is_system(system: Any) -> None:
    """Raise if what the user passes again is no system."""
    must_be(SYSTEMS, system, "system must be a lj.System", "lj.load_trajectory(path, system=system)")


def same_system(system: System, known: UnknownSystem, path: str | os.PathLike) -> System | Hybrid:
    """The system, which the user passes again, traced at a state of the motion; raise if the file has another one."""
    check_is_system(system)
    if known.state is None:
        return system
    try:
        state = State(*known.state)
        system = traced_phases(system, state)
        here = signature(system, state)
    except (LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RuntimeError) as error:
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
    return system


def made(cls: type, fields: dict[str, Any]) -> Any:
    """An object with these fields, each of the kind that its class says.

    **Raises:** `ValueError` or `KeyError` if they are not.
    """
    if unknown := set(fields) - set(fields_of(cls) or ()):
        raise ValueError(f"{cls.__name__} has no field {', '.join(sorted(unknown))[:200]}.")
    for name, x in fields.items():
        check_field(cls, name, x)
    if issubclass(cls, tuple):
        return cls(**fields)
    return without_init(cls, {name: fields[name] for name in fields_of(cls) or ()})


def result_of_names(said: dict[str, Any]) -> RESULTS:
    """The results whose names were written."""
    codes, now = said["codes"], np.asarray(said["codes"]).copy()
    names = {int(code): name for code, name in said["names"].items()}
    if names and not np.isin(now, list(names)).all():
        raise ValueError("a result has no name.")
    for code, name in names.items():
        if name not in RESULTS._name_to_item:
            raise ValueError(f"the result '{name[:80]}' is not known to this version of lagjax.")
        now[np.asarray(codes) == code] = int(RESULTS._name_to_item[name]._value)
    now = jnp.asarray(now) if isinstance(codes, jax.Array) else now
    return eqx.tree_at(lambda r: r._value, item(RESULTS.successful, 0), now)
