"""Tell whether a system is the one of a motion, by what its functions return at one state of the motion.

A signature holds the values and slopes of L, of R and of each constraint, and the force, each in one row. Two systems
whose signatures agree at a state in the middle of a motion count as the same.
"""

from collections.abc import Callable
from dataclasses import fields
from functools import partial
from typing import Any, NoReturn

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.jaxtools import compiled
from lagjax.system.coordinates import State
from lagjax.system.function_arguments import takes_of
from lagjax.system.hybrid import Hybrid
from lagjax.system.model import model_of
from lagjax.system.system import System, rate_of

# Values that differ by more than this, relative to the largest of their row, come from another function. Round-off is
# below it also where large terms cancel, in float32 too, unless only the last digits remain.
SAME = {np.dtype("float64"): 1e-7, np.dtype("float32"): 1e-3}

# The attributes that other code reads from a system.
SYSTEM_FIELDS = {field.name for of in (System, Hybrid) for field in fields(of)} - {"first"}


class UnknownSystem(eqx.Module):
    """A placeholder for a system that was not given: what a file knows about it.

    - `words`: its printed form; `angles` (n,): which coordinates are angles.
    - `signature`: what its functions returned at `state`, by role. `starts`: where the motions of a fit start, and
    `phase`: the number of the phase in which they start.
    """

    words: str = eqx.field(static=True)
    angles: tuple[bool, ...] = eqx.field(static=True)
    signature: dict[str, Array]
    state: PyTree
    starts: PyTree = None
    phase: int | None = eqx.field(static=True, default=None)

    def __repr__(self):
        return f"{self.words.splitlines()[0]}, not given"

    def __getattr__(self, name: str):
        if name in SYSTEM_FIELDS:
            _raise_unknown(self)
        raise AttributeError(name)


def signature(system: System | Hybrid, state: State) -> dict[str, np.ndarray]:
    """What each function of a system returns at a state, by role."""
    if isinstance(system, System):
        return _signature(system, state)
    found = {}
    for i, (name, phase) in enumerate(zip(system.names, system.systems)):
        for case, params in system.cases(state.params, i).items():
            of_phase = _signature(phase, state._replace(params=params))
            found |= {f"{role} of phase '{name}'{case}": x for role, x in of_phase.items()}
    names = [f"{i}: {switch.phase} -> {switch.to}, {switch.rest}" for i, switch in enumerate(system.switches)]
    return found | {f"switch {name}": np.zeros(0) for name in names} | system.laws_in_numbers(state)


def differences(there: dict[str, Any], here: dict[str, Any]) -> list[str]:
    """The differences between two signatures, in words."""
    found = [f"{role} is missing" for role in there if role not in here]
    found += [f"{role} is there, but was not before" for role in here if role not in there]
    for role in there:
        if role not in here:
            continue
        a, b = (np.asarray(x[role]) for x in (there, here))
        size = np.max(
            np.abs(np.nan_to_num(np.concatenate([a.ravel(), b.ravel()]), posinf=0.0, neginf=0.0)), initial=0.0
        )
        tolerance = SAME.get(a.dtype, 1e-2) * size
        if a.shape != b.shape:
            found.append(f"{role} has {len(b)} values and slopes, but had {len(a)}")
        elif not np.allclose(a, b, rtol=0.0, atol=tolerance, equal_nan=True):
            what = (
                "value" if a.size and not np.isclose(a[0], b[0], rtol=0.0, atol=tolerance, equal_nan=True) else "slope"
            )
            i = 0 if what == "value" else int(np.argmax(np.nan_to_num(np.abs(a - b), nan=np.inf)))
            found.append(f"{role}: its {what} was {a[i]:.9g}, and is {b[i]:.9g}")
    return found


@partial(compiled, in_numpy=True)
def _signature(system: System, s: State):
    found = {}

    def flat(*trees) -> Array:
        return jnp.concatenate([jnp.ravel(jnp.asarray(x, s.t.dtype)) for x in jax.tree.leaves(trees)])

    def values_and_slopes(function: Callable, *args, slopes):
        return flat(function(*args), jax.jacfwd(function, argnums=slopes)(*args))

    found["the Lagrangian"] = values_and_slopes(system.lagrangian, *s, slopes=(1, 2))
    if system.dissipation is not None:
        found["the dissipation"] = values_and_slopes(system.dissipation, *s, slopes=(2,))
    for name, c in system.constraints.items():
        words, slopes = ("", (1,)) if c.of_positions else (", of velocities,", (1, 2))
        found[f"the constraint '{name}'{words}"] = values_and_slopes(c.residual, *s, slopes=slopes)
    for name, f in system.states.items():
        found[f"the {rate_of(name)}"] = values_and_slopes(f, *s, slopes=(1, 2))
    if system.force is not None:
        ones = jax.tree.map(np.ones_like, model_of(system, *s).zero_multipliers())
        given = s._asdict() | {"multipliers": ones}
        found["the force"] = flat(system.force(*(given[name] for name in takes_of(system.force))))
    return found


def middle_state(t: Array, q: PyTree, v: PyTree, params: PyTree) -> State:
    """A state in the middle of a motion, among the finite ones; for a batch, of the first lane."""
    first = (0,) * (np.ndim(t) - 1)

    def one(x: Any) -> np.ndarray:
        return np.asarray(x)[first]

    t, q, v = jax.tree.map(one, (t, q, v))
    params = jax.tree.map(lambda x: one(x) if first and isinstance(x, (jax.Array, np.ndarray)) else x, params)
    known = np.all([np.isfinite(x.reshape(len(t), -1)).all(axis=1) for x in jax.tree.leaves((q, v))], axis=0)
    i = int(known.sum()) // 2
    return State(*jax.tree.map(lambda x: x[i], (t, q, v)), params)


def known_system(system: Any) -> Any:
    """Return the system, or raise if it is not known."""
    if isinstance(system, UnknownSystem):
        _raise_unknown(system)
    return system


def _raise_unknown(system) -> NoReturn:
    raise ValueError(
        f"this needs the functions of the system ({system.words.splitlines()[0]}), which a file does not contain.\n"
        "Fix: lj.load_trajectory(path, system=system), or load_fit or open_sweep, with the system that was integrated."
    )
