"""A system with elements as `integrate` solves it: a motion in one phase, whose modes change at switches."""

from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jax import dtypes
from jaxtyping import Array, PyTree

from lagjax.integrate.elements.in_modes import OneGuard, in_modes
from lagjax.integrate.elements.laws import Laws
from lagjax.integrate.elements.meeting import Meeting, Met
from lagjax.integrate.events.event import Crossing, EventKind, Guards, guards_of
from lagjax.integrate.jumps.find import OfParams
from lagjax.integrate.solve.segments import Phase
from lagjax.jaxtools import compiled, without_init
from lagjax.system import Elements, Hybrid, InModes, State, System

MOTION = "motion"


class InElements(Hybrid):
    """A system with elements, `user`, as a hybrid of one phase whose functions take modes."""

    laws: Laws
    user: System

    @property
    def elements(self) -> Elements | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.user.elements

    def given(self, params: PyTree, modes: Array | None = None) -> Any:
        """The parameters in these modes, or in rows of modes; without any, with all gaps open."""
        if isinstance(params, InModes):
            return params
        open_ones = np.zeros(self.laws.size, dtypes.canonicalize_dtype(int))
        return self.laws.given(params, open_ones if modes is None else modes)

    @property
    def first_phase(self) -> System:
        """The user's system without its elements."""
        return self.user.first_phase

    def cases(self, params: PyTree) -> dict[str, PyTree]:
        """The parameters where every contact holds, and where every one that can slide does."""
        return {f" {words}": self.laws.given(params, modes) for words, modes in self.laws.all_closed().items()}

    def laws_in_numbers(self, state: State) -> dict[str, np.ndarray]:
        found = {f"elements, impacts {self.laws.impacts}": np.zeros(0)}
        return found | jax.tree.map(np.asarray, self.laws.in_numbers(state))

    def __repr__(self):
        return repr(self.user)


def assembled(system: System, start: State, ts: Array | np.ndarray | None) -> InElements:
    """The assembly for a motion over these times, with all functions checked and traced."""
    assert system.elements is not None
    masked, laws = in_modes(system, start)
    most = system.elements.most_switches
    if ts is not None and (instants := laws.instants(ts, start.params)):
        # A power of two, so that a few instants more do not compile again.
        most = 1 << (most + instants - 1).bit_length()
    hybrid = Hybrid({MOTION: masked}, most_switches=most)
    return without_init(InElements, vars(hybrid) | {"laws": laws, "user": system})


def only_phase(assembly: InElements, start: State, events: Mapping[str, Crossing]) -> Phase:
    """The guard of all modes, and those of the recorded events; what happens where modes change."""
    laws, guarded = assembly.laws, bool(assembly.laws.guarded)
    modes = EventKind("modes", -1, terminal=True, most=1, takes_multipliers=True, long=True, holds=True)
    recorded = guards_of(events, assembly.user, start) if events else Guards((), ())
    functions = (OneGuard(laws),) * guarded + tuple(OfParams(guard) for guard in recorded.functions)
    guards = Guards(functions, (modes,) * guarded + recorded.kinds) if functions else None
    meeting = Meeting(assembly.systems[0], laws)
    return Phase(guards, (0,) * guarded, np.zeros((1, 2), np.int32), (), tuple(events), meeting)


@compiled
def modes_at(assembly: InElements, start: State) -> Met:
    """The modes that fit a state, and the velocities on what holds in them."""
    return Meeting(assembly.systems[0], assembly.laws).first(*start)[1]
