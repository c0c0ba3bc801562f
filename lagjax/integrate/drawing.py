"""What is plotted of a trajectory: its curves and charges by the user's names.

Some charges follow from the structure of a system: the momenta of coordinates that neither L nor a constraint contains,
and the Jacobi integral if nothing depends on time. `lj.symmetries` finds the others.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import PyTree

from lagjax.jaxtools import compiled
from lagjax.mechanics import Generator, NoetherCharge, conserved_momenta, conserves_jacobi_integral
from lagjax.system import coordinates


def curves(tree: PyTree):
    """Return one curve for each coordinate, by the user's names."""
    first = jax.tree.map(lambda x: np.asarray(x[0]), tree)
    columns = np.stack([np.ravel(x) for x in _rows(tree)])
    return dict(zip(coordinates.names(first), columns.T))


def finite(*curves):
    """Return the curves at the places where all are finite."""
    all_finite = np.isfinite(curves).all(axis=0)
    return tuple(x[all_finite] for x in curves)


def _rows(tree: PyTree):
    leaves = [np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(tree)]
    return np.concatenate(leaves, axis=1)


def columns(values):
    """Return the columns of an array, each with the suffix of its name."""
    values = np.asarray(values)
    if values.ndim == 1:
        return [("", values)]
    return [(f"[{i}]", column) for i, column in enumerate(values.T)]


PANEL, LONG = "change of charges\nat the outputs", 28


def panels(trajectory, charges: Any) -> dict[str, dict[str, np.ndarray]]:
    """Return the curves of a trajectory, by panel: coordinates, velocities, multipliers, and charges if requested.

    `charges`: whether to draw the charges known to be conserved; or functions of (t, q, v, params), by name.
    """
    found = {"q": curves(trajectory.q), "v": curves(trajectory.v)}
    if trajectory.multipliers:
        found["multipliers"] = {
            name + suffix: curve for name, values in trajectory.multipliers.items() for suffix, curve in columns(values)
        }
    if charges is not False and charges is not None:
        drawn = changes(trajectory, charges)
        # Longer names would leave no room for the curves.
        short = [name.split(" with ")[0] for name in drawn]
        short = [name if len(name) <= LONG else f"{name[:LONG]}…" for name in short]
        found[PANEL] = dict(zip(short if len(set(short)) == len(short) else drawn, drawn.values()))
    return found


def changes(trajectory, charges: Any) -> dict[str, np.ndarray]:
    """Return the change of each charge since its first value, (T,), relative to its largest term at the outputs."""
    of_system = charges is True
    functions = known_charges(trajectory) if of_system else _by_name(charges)
    if not functions:
        raise ValueError(
            "nothing is known to be conserved: L and the constraints contain every coordinate, or a force acts, and "
            "the Jacobi integral may change.\n"
            "Fix: traj.plot(charges=lj.symmetries(system, q, v, params)), which finds further symmetries, or functions "
            "of (t, q, v, params) by name."
        )
    values = _along(functions, trajectory.t, trajectory.q, trajectory.v, trajectory.params)
    found = {}
    # Compiled programs sort the keys of their results.
    for name in functions:
        value, size = values[name]
        value, size = np.asarray(value), np.asarray(size)
        if value.ndim != 1:
            raise ValueError(
                f"charge '{name}' must be one number, but has shape {value.shape[1:]}.\n"
                "Usual cause: the momentum of all coordinates, with the structure of q.\nFix: return one entry of it."
            )
        scale = max(np.nanmax(size), np.nanmax(np.abs(value)))
        found[name] = (value - value[0]) / (scale if scale > 0 else 1.0)
    return found


def known_charges(trajectory) -> dict[str, NoetherCharge]:
    """Return the charges that follow from the structure of the system."""
    model = trajectory.model
    if model.system.in_phases:
        raise ValueError(
            "it is not known what a motion conserves in all its phases.\n"
            'Fix: traj.plot(charges={"name": function}) with functions of (t, q, v, params), or draw one phase.'
        )
    found = [Generator.shift(name) for name in conserved_momenta(model)]
    if conserves_jacobi_integral(model):
        found.append(Generator.time_translation())
    return {generator.name: NoetherCharge(model.system, generator) for generator in found}


def _by_name(charges: Any) -> dict[str, Callable]:
    if isinstance(charges, Mapping) or hasattr(charges, "keys"):
        found = {name: charges[name] for name in charges.keys()}
    elif callable(charges):
        found = {getattr(charges, "__name__", "charge"): charges}
    else:
        raise TypeError(
            f"charges must be True, or functions by name, not {type(charges).__name__}.\n"
            'Fix: charges={"L_z": lj.noether_charge(system, lj.Generator.rotation("z"))}.'
        )
    for name, charge in found.items():
        if not callable(charge):
            raise TypeError(
                f"charge '{name}' must be a function of (t, q, v, params), not {type(charge).__name__}.\n"
                "Fix: pass the function itself, not its value."
            )
    return found


@compiled
def _along(functions, t: np.ndarray, q: PyTree, v: PyTree, params: PyTree):
    def at(t: np.ndarray, q: PyTree, v: PyTree):
        found = {}
        for name, charge in functions.items():
            value = charge(t, q, v, params)
            found[name] = value, charge.size(t, q, v, params) if isinstance(charge, NoetherCharge) else value * 0.0
        return found

    return jax.vmap(at)(t, q, v)
