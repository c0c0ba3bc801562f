"""The curves that are drawn of a trajectory and of its conserved charges.

Some charges follow from the structure of a system: the momenta of coordinates that neither L nor a constraint contains,
and the Jacobi integral if nothing depends on time. `lj.symmetries` finds the others.
"""

from collections.abc import Callable, Mapping

import jax
import numpy as np

from lagjax.integrate.trajectory.curves import columns, curves
from lagjax.jaxtools.compiled import compiled
from lagjax.mechanics.generators import Generator
from lagjax.mechanics.noether import NoetherCharge
from lagjax.mechanics.structure import conserved_momenta, conserves_jacobi_integral
from lagjax.system.hybrid import Hybrid

PANEL, LONG = "change of charges\nat the outputs", 28


def panels(trajectory, charges) -> dict[str, dict[str, np.ndarray]]:
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


def changes(trajectory, charges) -> dict[str, np.ndarray]:
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
    if isinstance(model.system, Hybrid):
        raise ValueError(
            "it is not known what a motion conserves in all its phases.\n"
            'Fix: traj.plot(charges={"name": function}) with functions of (t, q, v, params), or draw one phase.'
        )
    found = [Generator.shift(name) for name in conserved_momenta(model)]
    if conserves_jacobi_integral(model):
        found.append(Generator.time_translation())
    return {generator.name: NoetherCharge(model.system, generator) for generator in found}


def _by_name(charges) -> dict[str, Callable]:
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
def _along(functions, t, q, v, params):
    def at(t, q, v):
        found = {}
        for name, charge in functions.items():
            value = charge(t, q, v, params)
            found[name] = value, charge.size(t, q, v, params) if isinstance(charge, NoetherCharge) else value * 0.0
        return found

    return jax.vmap(at)(t, q, v)
