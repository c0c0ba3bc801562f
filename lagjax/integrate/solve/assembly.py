"""A motion with elements as `integrate` solves it: in each phase that has some, a system in modes with their laws."""

from typing import Any

import jax
import numpy as np
from jax import dtypes
from jaxtyping import Array, PyTree

from lagjax.integrate.in_modes import in_modes
from lagjax.integrate.laws import Laws
from lagjax.integrate.meeting import Meeting, Met
from lagjax.jaxtools import compiled, without_init
from lagjax.system import Elements, Hybrid, InModes, State, System, replace_fields, traced_system

MOTION = "motion"


class InElements(Hybrid):
    """The motion of `user`, a system with elements or a hybrid some of whose phases have some, as a hybrid whose
    functions take modes in these phases. `laws`: those of each phase, or None."""

    laws: tuple[Laws | None, ...]
    user: System | Hybrid

    @property
    def elements(self) -> Elements | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.user.elements

    @property
    def places(self) -> tuple[tuple[int, int], ...]:
        """Where the modes of each phase are among those of all."""
        ends = np.cumsum([0, *(0 if laws is None else laws.size for laws in self.laws)]).tolist()
        return tuple(zip(ends, ends[1:]))

    @property
    def modes(self) -> list[tuple[str, str]]:
        """The name and the kind of each mode, in the order of the phases."""
        several = isinstance(self.user, Hybrid) and len(list(filter(None, self.laws))) > 1
        return [
            (f"{phase}: {name}" if several else name, kind)
            for phase, laws in zip(self.names, self.laws)
            if laws is not None
            for name, kind in zip(laws.names, laws.kinds)
        ]

    def given(self, params: PyTree, modes: Array | None = None, phase: int = 0) -> Any:
        """What the functions of a phase take as `params`, in these modes of all phases, or rows of them; without any,
        with all gaps open."""
        laws = self.laws[phase]
        if laws is None or isinstance(params, InModes):
            return params
        open_ones = np.zeros(laws.size, dtypes.canonicalize_dtype(int))
        return laws.given(params, open_ones if modes is None else modes[..., slice(*self.places[phase])])

    @property
    def first_phase(self) -> System:
        """The user's system without its elements."""
        return self.user.first_phase

    def cases(self, params: PyTree, phase: int = 0) -> dict[str, PyTree]:
        """The parameters where every contact holds, and where every one that can slide does."""
        laws = self.laws[phase]
        if laws is None:
            return {"": params}
        return {f" {words}": laws.given(params, modes) for words, modes in laws.all_closed().items()}

    def laws_in_numbers(self, state: State) -> dict[str, np.ndarray]:
        found: dict[str, Any] = {}
        for phase, laws in zip(self.names, self.laws):
            if laws is None:
                continue
            of = "" if isinstance(self.user, System) else f" of phase '{phase}'"
            numbers = {f"elements, impacts {laws.impacts}": np.zeros(0)}
            numbers |= jax.tree.map(np.asarray, laws.in_numbers(state))
            found |= {f"{role}{of}": x for role, x in numbers.items()}
        return found

    def __repr__(self):
        return repr(self.user)


def assembled(user: System | Hybrid, start: State, ts: Array | np.ndarray | None) -> InElements:
    """The assembly for a motion over these times, with the functions of all phases checked and traced."""
    hybrid = user if isinstance(user, Hybrid) else Hybrid({MOTION: user})
    most, systems, laws = hybrid.most_switches if isinstance(user, Hybrid) else 0, [], []
    for system in hybrid.systems:
        if system.elements is None:
            systems.append(traced_system(system, start))
            laws.append(None)
            continue
        masked, of_phase = in_modes(system, start)
        systems.append(masked)
        laws.append(of_phase)
        most += system.elements.most_switches
        if ts is not None and (instants := of_phase.instants(ts, start.params)):
            # A power of two, so that a few instants more do not compile again.
            most = 1 << (most + instants - 1).bit_length()
    hybrid = replace_fields(hybrid, systems=tuple(systems), most_switches=most)
    return without_init(InElements, vars(hybrid) | {"laws": tuple(laws), "user": user})


@compiled
def modes_at(assembly: InElements, start: State) -> Met:
    """The modes that fit a state, and the velocities on what holds in them; of a system with elements."""
    (laws,) = assembly.laws
    assert laws is not None
    return Meeting(assembly.systems[0], laws).first(*start)[1]
