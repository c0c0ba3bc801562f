"""Routh's function: a system without its cyclic coordinates, whose momenta are parameters.

The momentum p_c = ∂L/∂v_c of a cyclic coordinate c is constant. With v_c found from it (`hamiltonian.py`), the function

    R(t, q, v) = L(t, q, v, v_c) - p_c·v_c

is a Lagrangian for the other coordinates: ∂R/∂q = ∂L/∂q and ∂R/∂v = ∂L/∂v at the v_c given by p_c, because the terms
with dv_c cancel. (Goldstein's R has the opposite sign.) Forces on the other coordinates are unchanged, with v_c given
by p_c, but must not depend on the cyclic coordinate; no force may act on the cyclic coordinate itself.

Source: Goldstein, *Classical Mechanics*, §8.3; Landau & Lifshitz, *Mechanics*, §41.
"""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree

from lagjax.analysis.formulations.hamiltonian import velocity_of
from lagjax.jaxtools import remembered
from lagjax.mechanics import forced_by, listed, what_changes_momentum
from lagjax.system import WITH_MULTIPLIERS, Holonomic, Model, System, check_system, coordinates, model_of, takes_of


class Routhian(eqx.Module):
    """Routh's function `R(t, q, v, params)` of the remaining coordinates: the Lagrangian of their system."""

    system: System
    cyclic: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t, q: PyTree, v: PyTree, params: PyTree):
        """R at a state of the remaining coordinates, `[L]`."""
        q, v = jax.tree.map(jnp.asarray, coordinates.as_floats((q, v)))
        return self._at(t, q, v, params)[0]

    def velocities(self, t, q: PyTree, v: PyTree, params: PyTree) -> dict[str, Array]:
        """The velocities of the cyclic coordinates, by name, `[q]/[t]`; integrate them to get the coordinates."""
        s = coordinates.state(t, q, v, params)
        return dict(zip(self.cyclic, self._at(*s)[1]))

    def full(self, q: PyTree, of_cyclic: Mapping):
        """The positions or velocities of all coordinates, from those of the remaining and of the cyclic ones."""
        return _together(q, self.cyclic, [of_cyclic[name] for name in self.cyclic])

    def force(self, t, q: PyTree, v: PyTree, params: PyTree):
        """The generalised forces on the remaining coordinates, in the structure of `q`."""
        force = self.system.force
        assert force is not None
        forces = force(t, *self._state(t, q, v, params), self._split(params)[0])
        if isinstance(forces, Mapping):
            return {name: forces[name] for name in q}
        indices = [_index(name) for name in self.cyclic]
        return jnp.stack([x for i, x in enumerate(jnp.asarray(forces)) if i not in indices])

    def dissipation(self, t, q: PyTree, v: PyTree, params: PyTree):
        """Rayleigh's function of the remaining coordinates."""
        dissipation = self.system.dissipation
        assert dissipation is not None
        return dissipation(t, *self._state(t, q, v, params), self._split(params)[0])

    def _state(self, t, q: PyTree, v: PyTree, params: PyTree):
        """The positions (zero for cyclic coordinates) and velocities of all coordinates."""
        u = self._at(t, q, v, params)[1]
        return _together(q, self.cyclic, [jnp.zeros_like(x) for x in u]), _together(v, self.cyclic, list(u))

    def _at(self, t, q: PyTree, v: PyTree, params: PyTree):
        params, momenta = self._split(params)
        shaped = coordinates.flatten(v)[0]
        zeros = [jnp.zeros_like(shaped[0])] * len(self.cyclic)
        q = _together(q, self.cyclic, zeros)
        model = model_of(self.system, t, q, q, params)
        remembered(model, (Routhian, self.cyclic), lambda: self._check(model))

        def of(u: Array):
            return self.system.lagrangian(t, q, _together(v, self.cyclic, list(u)), params)

        p = jnp.stack([jnp.asarray(momenta[name], shaped.dtype) for name in self.cyclic])
        found = velocity_of(jax.grad(of), p)
        u = jnp.where(found.regular & found.reached, found.v, jnp.nan)
        return of(u) - p @ u, u

    def _split(self, params: PyTree):
        if not isinstance(params, Mapping) or set(params) != {"params", "momenta"}:
            raise ValueError(
                "the parameters of a Routhian are those of the system and the momenta.\n"
                f'Fix: {{"params": params, "momenta": {{{", ".join(f"{name!r}: 1.0" for name in self.cyclic)}}}}}.'
            )
        missing = [name for name in self.cyclic if name not in params["momenta"]]
        if missing:
            raise ValueError(
                f"the momentum of {listed(missing)} is missing.\n"
                f'Fix: "momenta": {{..., "{missing[0]}": lj.momentum(system, t, q, v, params)["{missing[0]}"]}}.'
            )
        return params["params"], params["momenta"]

    def _check(self, model: Model):
        for name in self.cyclic:
            reason = next(what_changes_momentum(model, name), None)
            depends = next(forced_by(model, name), None)
            if reason is None and depends is not None:
                raise ValueError(
                    f"'{name}' cannot be eliminated: {depends}, so the motion of the others depends on where it is.\n"
                    f"Fix: leave '{name}' out of cyclic."
                )
            if reason is not None:
                raise ValueError(
                    f"'{name}' is not cyclic: {reason}, so its momentum need not be constant.\n"
                    f"Fix: leave '{name}' out of cyclic; lj.explain(system, t, q, v, params).structure.cyclic lists "
                    "those that L does not contain."
                )
        return True


def routhian(system: System, cyclic: str | Iterable[str]) -> System:
    """Return the system of the coordinates that remain when cyclic ones are eliminated by their momenta.

    >>> import lagjax as lj
    >>> def kepler(t, q, v, params):
    ...     return 0.5 * (v["r"] ** 2 + (q["r"] * v["angle"]) ** 2) + params["k"] / q["r"]
    >>> radial = routhian(lj.System(kepler), "angle")
    >>> params = {"params": {"k": 1.0}, "momenta": {"angle": 2.0}}
    >>> a, _ = lj.accelerations(radial, 0.0, {"r": 2.0}, {"r": 0.0}, params)
    >>> print(a["r"])
    0.25

    **Arguments:**

    - `system`: with q a dict, or an array (n,).
    - `cyclic`: which coordinates to eliminate, by name: a key of the dict that is a number, or `"q[1]"`.

    **Returns:** a `System` in the remaining coordinates, the dict without these keys, or the shorter array. Its
    parameters are `{"params": those of the system, "momenta": {name: p}}`, with p as `lj.momentum` gives it.
    Its constraints, forces and dissipation are those of the system. `routhian(...).lagrangian.velocities(t, q, v,
    params)` gives the cyclic velocities, by name.

    **Raises:** `ValueError`, when L is called, for a coordinate that is not cyclic, on which a force or constraint
    acts, or on which the forces on others depend; for parameters without the momenta. `ValueError`, at once, if a force
    depends on multipliers. The values are NaN where the momenta do not determine the cyclic velocities.

    Source: Goldstein, §8.3, with the opposite sign; Landau & Lifshitz, *Mechanics*, §41.
    """
    check_system(system, cyclic, states=False)
    names = (cyclic,) if isinstance(cyclic, str) else tuple(cyclic)
    if not names or len(set(names)) < len(names):
        raise ValueError('cyclic must name at least one coordinate, and each only once.\nFix: cyclic=["phi", "psi"].')
    if system.force is not None and takes_of(system.force) == WITH_MULTIPLIERS and system.constraints:
        raise ValueError(
            "the force depends on multipliers, which a Routhian does not support.\n"
            "Fix: lj.routhian of a system whose force is a function of (t, q, v, params)."
        )
    reduced = Routhian(system, names)

    def constraint(g):
        def of_rest(t, q: PyTree, params: PyTree):
            rest, _ = reduced._split(params)
            zero = jnp.zeros_like(coordinates.flatten(q)[0][0])
            return g(t, _together(q, names, [zero] * len(names)), rest)

        return of_rest

    left = {name: Holonomic(constraint(c.function)) for name, c in system.constraints.items() if c.of_positions}
    return System(
        reduced, left, force=None if system.force is None else reduced.force,
        dissipation=None if system.dissipation is None else reduced.dissipation,
    )  # fmt: skip


def _together(rest, names, values):
    """All coordinates, from the remaining ones `rest` and the `values` of the cyclic ones `names`."""
    if isinstance(rest, Mapping):
        duplicates = [name for name in names if name in rest]
        if duplicates:
            raise ValueError(
                f"{listed(duplicates)} is eliminated, but still among the coordinates.\nFix: leave it out of q0 and v0."
            )
        return {**rest, **dict(zip(names, values))}
    if jnp.ndim(rest) == 1:
        cyclic = dict(zip([_index(name) for name in names], values))
        remaining, count = iter([rest[i] for i in range(len(rest))]), len(rest) + len(names)
        return jnp.stack([cyclic[i] if i in cyclic else next(remaining) for i in range(count)])
    raise ValueError(
        'a Routhian needs coordinates by name, or in an array with one axis.\nFix: q = {"r": ..., "angle": ...}.'
    )


def _index(name: str):
    start, _, number = name.rstrip("]").rpartition("[")
    if start != "q" or not number.isdigit():
        raise ValueError(f"'{name}' is not an entry of an array q.\nFix: \"q[1]\".")
    return int(number)
