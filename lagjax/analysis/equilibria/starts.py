"""The inputs of a search for steady motions: starts, the coordinates that move in them, and integer parameters."""

from collections.abc import Callable, Iterable

import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import PyTree

from lagjax.analysis.equilibria.balance import MOMENTUM, VELOCITY, SteadySymmetries
from lagjax.jaxtools.tracing import numpy_of
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.structure import structure
from lagjax.system import coordinates
from lagjax.system.check_functions import traced_system
from lagjax.system.coordinates import State
from lagjax.system.model import model_of

AS_STARTS = 'starts=[{"theta": 0.1}, {"theta": 3.0}], or starts={"theta": jnp.linspace(-3.0, 3.0, 20)}'


def stacked(starts, what="starts") -> PyTree:
    """Starts as one tree whose leaves have a leading axis, from a list of states, such a tree, or one state."""
    if isinstance(starts, list):
        if not starts:
            raise ValueError(f"{what} is an empty list: a search needs a place to start from.\nFix: {AS_STARTS}.")
        structures = {jtu.tree_structure(start) for start in starts}
        if len(structures) > 1:
            raise ValueError(f"the {what} differ in structure: each must be like q.\nFix: {AS_STARTS}.")
        # Concrete values stay in NumPy, which compiles nothing.
        starts = coordinates.as_floats(starts)
        xp = numpy_of(starts)
        return jtu.tree_map(lambda *x: xp.stack([xp.asarray(y) for y in x]), *starts)
    leaves = jtu.tree_leaves(starts)
    if not leaves:
        raise ValueError(f"{what} has no coordinates.\nFix: {AS_STARTS}.")
    starts = jtu.tree_map(lambda x: numpy_of(x).asarray(x), coordinates.as_floats(starts))
    leaves = jtu.tree_leaves(starts)
    if all(x.ndim == 0 for x in leaves):
        return jtu.tree_map(lambda x: x[None], starts)
    counts = {x.shape[:1] for x in leaves}
    if len(counts) > 1:
        raise ValueError(
            f"the leaves of {what} have leading axes of different lengths: "
            f"{listed(sorted(str(x.shape) for x in leaves))}.\n"
            "Usual cause: one start whose coordinates are arrays, where several are expected.\n"
            f"Fix: a list of states, {what}=[q]."
        )
    if () in counts or min(counts)[0] == 0:
        raise ValueError(f"{what} contains no start.\nFix: {AS_STARTS}.")
    return starts


def stacked_one(q):
    """A state of rest at q."""
    q = jax.tree.map(lambda x: x[0], stacked([q]))
    return q, jax.tree.map(lambda x: numpy_of(x).zeros_like(x), q)


def checked(system, t, q, v, params):
    """The checked system and its state; integers in `params` become floats if the functions accept them."""
    floats = jtu.tree_map(lambda x: float(x) if type(x) is int else x, params)
    s = coordinates.state(t, q, v, floats)
    if any(type(x) is int for x in jtu.tree_leaves(params)):
        try:
            return traced_system(system, s), s
        except (TypeError, ValueError):
            # A count or an index must stay an integer.
            s = coordinates.state(t, q, v, params)
    return traced_system(system, s), s


def symmetries_of(system, s: State, cyclic, hold, moving: np.ndarray | None) -> SteadySymmetries:
    """The symmetries along which the motion is steady: those that `cyclic` names, or the `moving` (n,) coordinates."""
    if hold not in (VELOCITY, MOMENTUM, None):
        raise ValueError(f'hold must be "velocity", "momentum" or None, not {hold!r}.')
    names = coordinates.names(s.q)
    if cyclic is None:
        if moving is None:
            return SteadySymmetries(hold=hold)
        chosen = [name for name, moves in zip(names, moving) if moves]
    else:
        given = [cyclic] if isinstance(cyclic, str) or callable(cyclic) else list(cyclic)
        if all(callable(x) for x in given) and given:
            _check_fields(given, s)
            return SteadySymmetries(fields=tuple(given), hold=hold)
        chosen = _names_in(names, given)
        still = [name for name, moves in zip(names, moving if moving is not None else []) if moves]
        if others := [name for name in still if name not in chosen]:
            raise ValueError(
                f"{listed(others)} moves in the starts but is not among the cyclic coordinates, {listed(chosen)}.\n"
                f"Fix: give it a velocity of zero, or pass cyclic={[*chosen, *others]}."
            )
    _check_cyclic(system, s, chosen)
    return SteadySymmetries(places=tuple(names.index(name) for name in chosen), hold=hold)


def _names_in(names, given: Iterable):
    """The coordinates with the given names; the name of an array means all its entries."""
    chosen = []
    for name in given:
        entries = [x for x in names if x == name or isinstance(name, str) and x.split("[")[0] == name]
        if not entries:
            raise ValueError(
                f"cyclic names {name!r}, and the coordinates are {listed(names)}.\n"
                "Fix: use these names, or functions motion(q, params) that return a velocity like v."
            )
        chosen += entries
    return list(dict.fromkeys(chosen))


def _check_cyclic(system, s, chosen):
    known = structure(model_of(system, *s)) if chosen else None
    not_cyclic = [name for name in chosen if known is not None and name not in known.cyclic]
    if not_cyclic:
        raise ValueError(
            f"L depends on {listed(not_cyclic)}, which moves at a constant rate: there is no steady motion along it.\n"
            "Usual cause: a start gives a velocity to a coordinate that is not cyclic, or the motion is a rotation of "
            "several coordinates.\n"
            "Fix: velocities of zero; or the symmetry as a function, cyclic=lambda q, params: {...}, which returns the "
            'velocity of a motion at a unit rate, such as {"x": -q["y"], "y": q["x"]}.'
        )


def _check_fields(fields: list[Callable], s: State):
    for field in fields:
        value = jax.eval_shape(lambda q, params, field=field: field(q, params), s.q, s.params)
        if jtu.tree_structure(value) != jtu.tree_structure(s.q) or jtu.tree_map(jnp.shape, value) != jtu.tree_map(
            jnp.shape, s.q
        ):
            raise ValueError(
                "cyclic=motion(q, params) must return a velocity like v, one number per coordinate.\n"
                f"  q has shapes {jtu.tree_map(jnp.shape, s.q)}\n  it has {jtu.tree_map(jnp.shape, value)}\n"
                "Fix: return the structure of q, with 0.0 for coordinates that do not move (0.0 * q[...] for arrays)."
            )
