"""Routh's function: a system without its cyclic coordinates, whose momenta are parameters.

With a cyclic coordinate c its momentum p_c = ∂L/∂v_c is constant. Solved for v_c (`legendre.py`), the function

    R(t, q, v) = L(t, q, v, v_c) - p_c·v_c

is a Lagrangian for the other coordinates: ∂R/∂q = ∂L/∂q and ∂R/∂v = ∂L/∂v with v_c taken from p_c, since what v_c
changes cancels. (Goldstein's R has the other sign.) Forces on the others stay what they are, with v_c taken from p_c,
where they do not depend on the cyclic coordinate; on it none may act.

Source: Goldstein, *Classical Mechanics*, §8.3; Landau & Lifshitz, *Mechanics*, §41.
"""

from collections.abc import Iterable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from lagjax.analysis.legendre import velocity_of
from lagjax.mechanics import coordinates
from lagjax.mechanics.constraints import Holonomic
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.memory import kinds, remembered
from lagjax.mechanics.reactions import reacts
from lagjax.mechanics.refusals import check_system
from lagjax.mechanics.structure import forced_by, what_changes_momentum
from lagjax.mechanics.system import System


class Routhian(eqx.Module):
    """Routh's function `R(t, q, v, params)` of the coordinates that are left: the Lagrangian of their system."""

    system: System
    cyclic: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, t, q, v, params):
        """R at a state of the coordinates that are left, `[L]`."""
        q, v = jax.tree.map(jnp.asarray, coordinates.as_floats((q, v)))
        return self._at(t, q, v, params)[0]

    def velocities(self, t, q, v, params) -> dict[str, Array]:
        """The velocities of the cyclic coordinates, by name, `[q]/[t]`: integrated, these give the coordinates."""
        s = coordinates.state(t, q, v, params)
        return dict(zip(self.cyclic, self._at(*s)[1]))

    def full(self, q, of_cyclic: Mapping):
        """A position or a velocity of all coordinates, of one of those that are left and one by name of the others."""
        return _together(q, self.cyclic, [of_cyclic[name] for name in self.cyclic])

    def force(self, t, q, v, params):
        """The generalized forces on the coordinates that are left, like these."""
        force = self.system.force
        assert force is not None
        found = force(t, *self._state(t, q, v, params), self._parted(params)[0])
        if isinstance(found, Mapping):
            return {name: found[name] for name in q}
        places = [_place(name) for name in self.cyclic]
        return jnp.stack([x for i, x in enumerate(jnp.asarray(found)) if i not in places])

    def dissipation(self, t, q, v, params):
        """Rayleigh's function of the coordinates that are left."""
        dissipation = self.system.dissipation
        assert dissipation is not None
        return dissipation(t, *self._state(t, q, v, params), self._parted(params)[0])

    def _state(self, t, q, v, params):
        """Positions, cyclic ones zero, and velocities of all coordinates."""
        u = self._at(t, q, v, params)[1]
        return _together(q, self.cyclic, [jnp.zeros_like(x) for x in u]), _together(v, self.cyclic, list(u))

    def _at(self, t, q, v, params):
        params, momenta = self._parted(params)
        shaped = coordinates.flatten(v)[0]
        zeros = [jnp.zeros_like(shaped[0])] * len(self.cyclic)
        q = _together(q, self.cyclic, zeros)
        known = (Routhian, self.cyclic, self.system.read, kinds((t, q, params)))
        remembered(self.system, known, lambda: self._check(t, q, _together(v, self.cyclic, zeros), params))
        of = lambda u: self.system.lagrangian(t, q, _together(v, self.cyclic, list(u)), params)
        p = jnp.stack([jnp.asarray(momenta[name], shaped.dtype) for name in self.cyclic])
        found = velocity_of(jax.grad(of), p)
        u = jnp.where(found.regular & found.reached, found.v, jnp.nan)
        return of(u) - p @ u, u

    def _parted(self, params):
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

    def _check(self, t, q, v, params):
        for name in self.cyclic:
            reason = next(what_changes_momentum(self.system, name, t, q, v, params), None)
            depends = next(forced_by(self.system, name, t, q, v, params), None)
            if reason is None and depends is not None:
                raise ValueError(
                    f"'{name}' cannot be eliminated: {depends}, and the others then depend on where it is.\n"
                    f"Fix: leave '{name}' out of cyclic."
                )
            if reason is not None:
                raise ValueError(
                    f"'{name}' is not cyclic: {reason}, and its momentum need not stay.\n"
                    f"Fix: leave '{name}' out of cyclic; lj.explain(system, t, q, v, params).structure.cyclic lists "
                    "those that L does not contain."
                )
        return True


def routhian(system: System, cyclic: str | Iterable[str]) -> System:
    """Return the system of the coordinates that are left when cyclic ones are eliminated by their momenta.

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

    **Returns:** a `System` in the coordinates that are left, the dict without these keys, or the shorter array. Its
    parameters are `{"params": those of the system, "momenta": {name: p}}`, with p as `lj.momentum` gives it.
    Its constraints, forces and dissipation are those of the system. `routhian(...).lagrangian.velocities(t, q, v,
    params)` gives the cyclic velocities, by name.

    **Raises:** `ValueError`, when L is called, for a coordinate that is not cyclic, is acted on by a force or a
    constraint, or that forces on others depend on; for parameters without the momenta; NaN where the momenta do not
    tell the cyclic velocities. At once where a force depends on multipliers.

    Source: Goldstein, §8.3, with the other sign; Landau & Lifshitz, *Mechanics*, §41.
    """
    check_system(system, cyclic)
    names = (cyclic,) if isinstance(cyclic, str) else tuple(cyclic)
    if not names or len(set(names)) < len(names):
        raise ValueError('cyclic names each coordinate to eliminate once.\nFix: cyclic=["phi", "psi"].')
    if reacts(system):
        raise ValueError(
            "the force depends on multipliers, and those of the coordinates that are left are not asked for.\n"
            "Fix: lj.routhian of a system whose force is a function of (t, q, v, params)."
        )
    reduced = Routhian(system, names)

    def constraint(g):
        def of_rest(t, q, params):
            rest, _ = reduced._parted(params)
            zero = jnp.zeros_like(coordinates.flatten(q)[0][0])
            return g(t, _together(q, names, [zero] * len(names)), rest)

        return of_rest

    left = {name: Holonomic(constraint(c.g)) for name, c in system.constraints.items() if isinstance(c, Holonomic)}
    return System(
        reduced, left, force=None if system.force is None else reduced.force,
        dissipation=None if system.dissipation is None else reduced.dissipation,
    )  # fmt: skip


def _together(rest, names, values):
    """All coordinates, of those that are left and the others one by one."""
    if isinstance(rest, Mapping):
        twice = [name for name in names if name in rest]
        if twice:
            raise ValueError(
                f"{listed(twice)} is eliminated, and among the coordinates still.\nFix: leave it out of q0 and v0."
            )
        return {**rest, **dict(zip(names, values))}
    if jnp.ndim(rest) == 1:
        places = dict(zip([_place(name) for name in names], values))
        left, count = iter([rest[i] for i in range(len(rest))]), len(rest) + len(names)
        return jnp.stack([places[i] if i in places else next(left) for i in range(count)])
    raise ValueError(
        'a Routhian needs coordinates by name, or in an array of one axis.\nFix: q = {"r": ..., "angle": ...}.'
    )


def _place(name):
    start, _, number = name.rstrip("]").rpartition("[")
    if start != "q" or not number.isdigit():
        raise ValueError(f"'{name}' is no entry of an array q.\nFix: \"q[1]\".")
    return int(number)
