"""What `lj.explain` says of a motion in phases: the graph of the phases, and each phase."""

from dataclasses import dataclass

from lagjax.display import plots as plot
from lagjax.display.printable import by_line
from lagjax.mechanics.accelerations import accelerations
from lagjax.system.coordinates import State
from lagjax.system.hybrid import Hybrid


@dataclass(frozen=True, repr=False)
class HybridExplanation:
    """The explanation of a hybrid system at one state; it prints itself and draws its graph.

    - `phases`: by name, the `Explanation` of each phase.
    - `switches`: for each switch the phase that it ends, the phases to which it leads, the name of its guard, and the
      value of the guard at the state; None if the state does not belong to that phase.
    - `unreachable`: phases to which no switch leads, except the first. `final`: phases that no switch leaves.

    >>> import lagjax as lj
    >>> ball = lj.System(lambda t, q, v, params: 0.5 * v**2 - 10.0 * q)
    >>> bounce = lj.Switch("flying", to="flying", when=lj.touches(lambda t, q, params: q, restitution=0.5))
    >>> found = lj.explain(lj.Hybrid({"flying": ball}, [bounce]), 0.0, 5.0, 0.0)
    >>> print(list(found.phases), found.final)
    ['flying'] ()
    """

    phases: dict
    switches: tuple[tuple[str, tuple[str, ...], str, float | None], ...]
    unreachable: tuple[str, ...]
    final: tuple[str, ...]

    def plot(self):
        """Draw the phases, with an arrow for each switch; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib.
        """
        arrows = [(phase, to, guard) for phase, targets, guard, _ in self.switches for to in targets]
        return plot.graph(list(self.phases), arrows)

    def __repr__(self):
        width = max(map(len, self.phases))
        lines = ["Hybrid"]
        for name, found in self.phases.items():
            held = ", ".join(map(repr, found.structure.constraints)) if found.structure is not None else ""
            count = found.degrees_of_freedom
            words = [f"{count} degree{'' if count == 1 else 's'} of freedom", *([f"held by {held}"] if held else [])]
            words += ["no switch leads here"] if name in self.unreachable else []
            words += ["no switch leaves it"] if name in self.final else []
            lines.append(f"  {name:<{width}}  {'; '.join(words)}")
            for _, targets, guard, value in (switch for switch in self.switches if switch[0] == name):
                now = "" if value is None else f", now {value:.6g}"
                lines.append(f"  {'':<{width}}    -> {' or '.join(targets)}, when {guard} reaches zero{now}")
            if found.problem:
                lines.append(f"  {'':<{width}}    problem: {found.problem.splitlines()[0]}")
        return by_line("\n".join(lines))


def explained(hybrid: Hybrid, phases: dict, state: State) -> HybridExplanation:
    """Build the explanation of a hybrid from the explanations of its phases at a state."""
    at = {name: _multipliers(system, phases[name], state) for name, system in zip(hybrid.names, hybrid.systems)}
    switches = []
    for switch in hybrid.switches:
        multipliers = at[switch.phase]
        value = None if multipliers is None else float(switch.value(*state[:3], multipliers, state.params))
        targets = (switch.to,) if switch.rest in (None, switch.to) else (switch.to, switch.rest)
        switches.append((switch.phase, targets, _name(switch.when), value))
    reached = {to for _, targets, _, _ in switches for to in targets} | {hybrid.names[int(hybrid.first)]}
    left = {phase for phase, *_ in switches}
    return HybridExplanation(
        phases, tuple(switches), tuple(name for name in hybrid.names if name not in reached),
        tuple(name for name in hybrid.names if name not in left),
    )  # fmt: skip


def _multipliers(system, explanation, state):
    """The multipliers of a phase; None if the state does not belong to it."""
    if explanation.problem or any(label == "off the constraints" for label, _ in explanation.rows):
        return None
    return accelerations(system, *state)[1] if system.constraints else {}


def _name(guard):
    name = getattr(guard, "__name__", type(guard).__name__.lower())
    return "its guard" if name == "<lambda>" else name
