"""The error of a failed motion: in the user's terms, or from inside a program by the message of its result; warnings.

At run time equinox raises the largest code of the lanes that fail. An empty batch has no largest code, so the code
passes through a primitive that gives an empty batch one of success.

By which contact a motion with elements ended, numbers show. With the rows A of contacts, the mass matrix M, and
constraints that always hold, W = A M⁻¹ Aᵀ (reduced by them) is how fast each gap and each sliding velocity accelerates
by a unit of each force. A contact with the normal force λ that slides to the side s = ±1 has the friction -s μ λ, and
opens by

    (W_NN - s μ W_NT) λ

so that above μ = W_NN / (s W_NT) its force closes it: then no λ keeps a gap closed that would close without it.

Source: Painlevé, C. R. Acad. Sci. Paris 121 (1895) 112; Génot & Brogliato, Eur. J. Mech. A/Solids 18 (1999) 653.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple, NoReturn

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from lagjax.integrate import arguments
from lagjax.integrate.arguments import REFUSED, check_finite
from lagjax.integrate.diagnosis import UNKNOWN, in_doubt, of_guards, stopped_early
from lagjax.integrate.events.event import EventWarning, Guards
from lagjax.integrate.problem import Problem
from lagjax.integrate.results import RESULTS, columns, ended_well, is_among, message, pack
from lagjax.integrate.settings import Settings
from lagjax.integrate.solve.one_motion import START_TOLERANCES
from lagjax.integrate.stepping import tolerances_at
from lagjax.integrate.trajectory import Trajectory
from lagjax.jaxtools import as_usual, compiled, primitive
from lagjax.mechanics import accelerations, consistent_state, describe, explain_failure, listed
from lagjax.system import OF_STATE, Holonomic, Hybrid, State, System, constraints, coordinates, model_of, takes_of, warn

# A gap is fixed by constraints if at most this part of its slope is independent of theirs.
FIXED = 1e-8
# A gap is closed below this part of the largest coordinate.
CLOSED = 1e-9
# So many of the last changes of modes are named.
LAST = 8


class AtContacts(NamedTuple):
    """The contacts at one state.

    `gaps` (k_N,), `slips` (k_T,); `response` (k, k): W; `fixed` (k_N,): which gaps the constraints fix; `zero`: below
    this a gap is closed.
    """

    gaps: np.ndarray
    slips: np.ndarray
    response: np.ndarray
    fixed: np.ndarray
    zero: float


def of_elements(trajectory, start: State) -> Exception:
    """The error of a failed motion with elements."""
    result, switches, count = trajectory.result, trajectory.switches, len(trajectory.switches)
    phase, end = trajectory.last_phase(), trajectory.end
    laws, user = trajectory.system.laws[phase], trajectory.system.user.phases[phase]
    last = list(dict.fromkeys(switches.ways[i] for i in np.asarray(switches.way)[max(0, count - LAST) : count]))
    when = f"t = {float(end.t):.9g}"
    # A motion that does not begin has no end.
    begun = count or all(np.all(np.isfinite(x)) for x in jax.tree.leaves((end.q, end.v)))
    s = State(end.t, end.q, end.v, trajectory.params) if begun else start._replace(params=trajectory.params)
    if is_among(result, [RESULTS.element_refused]):
        return _refused([laws for laws in trajectory.system.laws if laws is not None], s)
    if is_among(result, [RESULTS.normal_below_zero]):
        return _lifted(laws, s)
    if is_among(result, [RESULTS.too_many_switches]):
        return _against_constraints(laws, user, s) or RuntimeError(
            f"there were {count} changes of modes until {when}, the last ones of {listed(last)}, and that is all there "
            "is room for.\n"
            "Usual cause: very many impacts before a contact rests; a force that pulls a contact to and fro; the "
            "instants of a sampled control.\n"
            "Fix: elements=lj.Elements({...}, most_switches=1000); slower_than= of the contact."
        )
    if is_among(result, [RESULTS.guard_below_zero]):
        return _against_constraints(laws, user, s) or _inside(laws, user, s)
    if is_among(result, [RESULTS.no_contact_forces]):
        return _against_constraints(laws, user, s) or RuntimeError(
            f"no forces obey the laws of contact and friction together at {when}"
            f"{f', where {listed(last[-1:])} changes' if last else ''}{_jammed(laws, user, s)}.\n"
            "Usual cause: Painlevé's paradox, friction that pushes a contact together harder than it is pushed apart.\n"
            "Fix: a smaller friction, or a contact with a spring and a damper in place of a rigid one."
        )
    if is_among(result, REFUSED):
        check_finite(s)
        state = coordinates.as_arrays(s, s.t.dtype)
        if reason := explain_failure(model_of(replace(user, elements=None), *state), state):
            return ValueError(reason)
    return RuntimeError(f"at {when}: {message(result)}")


def _refused(every: list, s: State) -> Exception:
    """The error of numbers that no law of these phases allows."""
    t, q, v, params = coordinates.as_arrays(s, s.t.dtype)
    numbers = [number for laws in every for number in laws.numbers(t, params)]
    found = [(role, np.asarray(value)) for role, value, allowed in numbers if not np.all(allowed)]
    for laws in every if not found else ():
        # Those that depend on speeds.
        for law in laws.normals:
            rates = jax.jvp(lambda t, q, law=law: law.gaps(t, q, params), (t, q), (jnp.ones_like(t), v))[1]
            e = np.asarray(law.returned(jnp.maximum(-rates, 0.0), params))
            found += [(f"the restitution of '{law.name}'", e)] * (not np.all((e >= 0) & (e <= 1)))
        for law in laws.tangents:
            mu = np.asarray(law.kinetic(jnp.abs(law.slips(t, q, v, params)), params))
            found += [(f"the coefficient of '{law.name}'", mu)] * (not np.all(mu >= 0))
    said = ", ".join(f"{role} is {value}" for role, value in found)
    above = any(role.startswith(("every", "the stiffness")) for role, _ in found)
    return ValueError(
        f"{said}: friction, normal forces, stiffness and damping are not below zero, a restitution is 0 to 1, and a "
        "stiffness and the time between instants are above zero.\n"
        "Usual cause: a number in params, or from a function of them, that is NaN or has another sign or unit.\n"
        f"Fix: {'jnp.exp(p)' if above else 'jnp.abs(p)'} in the function of the element, or another value in params."
    )


def _lifted(laws, s: State) -> Exception:
    """The error of a normal force, a function of the state, that fell below zero."""
    t, q, v, params = coordinates.as_arrays(s, s.t.dtype)
    found = {law.name: law.normal_forces(t, q, v, {}, params) for law in laws.sided if not law.both}
    least = {name: float(jnp.min(force)) for name, force in found.items()}
    name = min(least, key=lambda name: least[name])
    return RuntimeError(
        f"the normal force of '{name}' falls below zero at t = {float(s.t):.9g}: {least[name]:.3g}. A surface that "
        "presses from one side does not hold the body there any more, and friction is not defined.\n"
        "Usual cause: a lift above the weight; a normal force with the other sign.\n"
        "Fix: lj.Contact(gap, friction=, sliding=), which lets go; normal='name' of a lj.Holonomic, whose multiplier "
        "presses from both sides, or jnp.abs(N) in the function, for a guide that does."
    )


def at_contacts(laws, user: System, s: State) -> AtContacts:
    """The contacts of a system with elements, `user`, at a state."""
    t, q, v, params = coordinates.as_arrays(s, s.t.dtype)
    model = model_of(replace(user, elements=None), t, q, v, params)
    x, u = model.vectors(q, v)

    def gaps(x: Array):
        return jnp.concatenate([law.gaps(t, model.tree(x), params) for law in laws.normals] or [x[:0]])

    def slips(u: Array):
        return jnp.concatenate([law.slips(t, q, model.tree(u), params) for law in laws.tangents] or [u[:0]])

    # One program: its operations one by one take XLA a second.
    @jax.jit
    def at(x: Array, u: Array):
        mass, held = jax.hessian(model.lagrangian, argnums=2)(t, x, u), constraints.jacobian(model, t, x, u)
        return mass, held, jax.jacfwd(gaps)(x), jax.jacfwd(slips)(u), gaps(x), slips(u)

    mass, held, of_gaps, of_slips, open_by, sliding = map(np.asarray, at(x, u))
    rows, m = np.concatenate([of_gaps, of_slips]), len(held)
    saddle = np.block([[mass, held.T], [held, np.zeros((m, m))]])
    known = np.concatenate([rows.T, np.zeros((m, len(rows)))])
    response = rows @ np.linalg.lstsq(saddle, known, rcond=None)[0][: x.size]
    own = of_gaps - of_gaps @ np.linalg.pinv(held, rcond=FIXED) @ held
    fixed = np.linalg.norm(own, axis=1) <= FIXED * np.linalg.norm(of_gaps, axis=1)
    size = np.max(np.abs(x), initial=1e-300)
    return AtContacts(open_by, sliding, response, fixed & (len(held) > 0), CLOSED * size)


def _against_constraints(laws, user: System, s: State) -> Exception | None:
    """The error of gaps that are closed, or below zero, and cannot open since constraints fix them."""
    found = at_contacts(laws, user, s)
    which = np.flatnonzero(found.fixed & (found.gaps <= found.zero))
    if not which.size:
        return None
    said = ", ".join(f"'{laws.names[i]}' = {found.gaps[i]:.3g}" for i in which)
    return ValueError(
        f"the constraints {listed(list(user.constraints))} fix the gap {said} at t = {float(s.t):.9g}, so that no "
        "force of the contact can open it.\n"
        "Usual cause: the same body held by a constraint and by a contact.\n"
        "Fix: leave out the contact, or the constraint."
    )


def _inside(laws, user: System, s: State) -> Exception:
    """The error of a motion that starts inside contacts."""
    gaps, names, closed = at_contacts(laws, user, s).gaps, laws.names, {}
    inside = ", ".join(f"'{names[i]}' = {gaps[i]:.3g}" for i in np.flatnonzero(gaps < 0))
    for law in laws.normals:
        below = np.flatnonzero(gaps[slice(*law.at)] < 0)
        if below.size:
            closed[law.name] = Holonomic(lambda t, q, params, law=law, below=below: law.gaps(t, q, params)[below])
    touching = replace(user, elements=None, constraints=dict(user.constraints) | closed)
    try:
        q, _ = consistent_state(touching, *s)
        fix = f"the nearest state that touches, q0 = {describe(q)}."
    except ValueError:
        fix = "move the start out by that."
    return ValueError(
        f"the motion starts inside a contact: the gap {inside} is below zero.\n"
        "Usual cause: positions in rounded numbers, or a radius forgotten in the gap.\n"
        f"Fix: {fix}"
    )


def _jammed(laws, user: System, s: State) -> str:
    """In words, the closed contacts that their own friction presses together harder than they push."""
    found, said, normals = at_contacts(laws, user, s), [], laws.count[0]
    for law in laws.tangents:
        for place in range(*law.at):
            i = laws.owners[place - normals]
            slip = found.slips[place - normals]
            if i < 0 or abs(found.gaps[i]) > found.zero:
                continue
            own, coupling = found.response[i, i], np.sign(slip) * found.response[i, place]
            mu = float(law.kinetic(jnp.abs(jnp.asarray([slip])), s.params)[0])
            if coupling > 0 and own <= mu * coupling:
                said.append(
                    f"'{laws.names[i]}', which slides with {mu:.6g}, presses itself together with friction above "
                    f"{own / coupling:.6g}"
                )
    return f": {'; '.join(said)}" if said else ""


# What a program that ends can say besides its result.
INSIDE = """
Usual cause: parameters or a start far from those meant, which a sampler, a search or a lane of a batch tries.
Fix: throw=False: outputs are then NaN from there on, and traj.result says why. A sampler takes found.log_posterior of a
fit (docs/fitting.md), -inf where a motion fails, or jnp.where(traj.result == lj.RESULTS.successful, density, -jnp.inf).
"""


@as_usual
def raise_at_run_time(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory; if it failed, the program that computes it ends with the message of its result."""
    code = _code_p.bind(jnp.asarray(trajectory.result._value))
    result = eqx.tree_at(lambda result: result._value, trajectory.result, code)
    words = [words + INSIDE for words in RESULTS._index_to_message]
    return eqxi.branched_error_if(trajectory, ~ended_well(result), code, words)


def _batched(operands: Sequence, axes: Sequence):
    (code,), (axis,) = operands, axes
    if code.shape[axis] == 0:
        return jnp.full(code.shape[:axis] + code.shape[axis + 1 :], RESULTS.successful._value), None
    return _code_p.bind(code), axis


def _same(code):
    return code


_code_p = primitive("result_code", _same, _same, batched=_batched)


# Switches at times that differ by less than this part of the last time are simultaneous.
AT_ONE_TIME = 1e-12
# Of so many gaps between switches, the last ones that are not of zero length, most have one ratio.
ENOUGH = 12
# A switch that changes velocities by less than this part of the largest one changes nothing.
STILL = 1e-12


def raise_failure(trajectory: Trajectory, start: State, settings: Settings, guards) -> NoReturn:
    """Raise the error of a failed motion; `start` is its first state, `guards` those of each phase."""
    # The guards of elements take modes, and are said in words of their own.
    elements = trajectory.in_phases and trajectory.system.elements is not None
    about_guards = "" if elements else of_guards(trajectory, guards)
    if trajectory.in_phases:
        _raise_in_phase(trajectory, start, settings, about_guards)
    _raise(trajectory, start, settings, about_guards)


def _raise(trajectory, start: State, settings: Settings, about_guards: str, where="") -> NoReturn:
    result = trajectory.result
    model, start = trajectory.model, coordinates.as_arrays(start, start.t.dtype)
    if is_among(result, [RESULTS.start_off_constraints]):
        found = compiled(tolerances_at)(start._replace(params=None), trajectory.t, settings)
        tolerances = (START_TOLERANCES * np.asarray(tolerance) for tolerance in found)
        raise ValueError(where + arguments.off_constraints(model, start, *tolerances))
    if is_among(result, arguments.REFUSED):
        arguments.check_finite(start)
        raise ValueError(where + (explain_failure(model, start) or message(result)))
    raise RuntimeError(where + stopped_early(trajectory, settings, about_guards))


def _raise_in_phase(trajectory, start: State, settings: Settings, about_guards: str) -> NoReturn:
    hybrid, switches, result = trajectory.system, trajectory.switches, trajectory.result
    if hybrid.elements is not None and _is_of_elements(trajectory, start):
        raise of_elements(trajectory, start)
    if is_among(result, [RESULTS.too_many_switches]):
        raise RuntimeError(_too_many(trajectory))
    if is_among(result, [RESULTS.guard_below_zero]):
        raise ValueError(_below_zero(hybrid, start))
    if is_among(result, [RESULTS.guard_not_seen]):
        raise RuntimeError(
            f"a guard of phase '{hybrid.names[trajectory.last_phase()]}', which began at t = "
            f"{float(trajectory.end.t):.9g}, is below zero at t = {float(trajectory.t[-1]):.9g}, but no crossing of "
            f"zero was found{_not_seen(trajectory, settings)}.\n"
            "Fix: a guard that is continuous and above zero as long as its phase lasts; or max_step=, so that steps "
            "see where it dips below."
        )
    if is_among(result, [RESULTS.reset_not_finite]):
        raise RuntimeError(_no_state_after(trajectory))
    count, phase = len(switches), trajectory.last_phase()
    entered = start
    if count:
        after = switches.t, switches.q_after, switches.v_after
        entered = State(*jax.tree.map(lambda x: np.asarray(x)[count - 1], after), trajectory.params)
    there = f"in phase '{hybrid.names[phase]}', entered at t = {float(entered.t):.9g}: "
    problem, how = (hybrid.systems[phase], trajectory.params, trajectory.asked), trajectory.static.how
    arrays, static = pack(problem, how, trajectory.static.integrate)
    fields = {
        name: getattr(trajectory, name) for name in ("q", "v", "end", "stats", "scaled_error", "result", "tolerance")
    }
    names = hybrid.systems[phase].constraints

    def of_phase(tree: PyTree):
        return {name: tree[name] for name in names}

    fields["end"] = fields["end"]._replace(multipliers=of_phase(fields["end"].multipliers))
    alone = Trajectory(
        t=trajectory.t, multipliers=of_phase(trajectory.multipliers), events={}, arrays=arrays, static=static, **fields
    )
    _raise(alone, entered, settings, about_guards, there)


def _is_of_elements(trajectory, start: State) -> bool:
    """Whether elements ended a motion, and no switch of phases."""
    result, hybrid = trajectory.result, trajectory.system
    if is_among(result, [RESULTS.element_refused]):
        return True
    of_switch = is_among(result, [RESULTS.guard_not_seen, RESULTS.reset_not_finite])
    of_switch = of_switch or is_among(result, [RESULTS.guard_below_zero]) and bool(_switches_below(hybrid, start))
    return hybrid.laws[trajectory.last_phase()] is not None and not of_switch


def _too_many(trajectory):
    switches = trajectory.switches
    t, count = np.asarray(switches.t)[: len(switches)], len(switches)
    gaps, last = np.diff(t), float(t[-1])
    apart = gaps[gaps > AT_ONE_TIME * max(abs(last), 1e-300)]
    said = f"there were {count} switches until t = {last:.9g}, and one more exceeds most_switches = {count}.\n"
    ratios = apart[1:][-ENOUGH:] / apart[:-1][-ENOUGH:]
    ratio = float(np.median(ratios)) if ratios.size > 1 else 1.0
    if ratio < 1 and np.mean(abs(ratios - ratio) < 0.1 * ratio) > 0.5:
        end = last + (gaps[-1] * ratio / (1 - ratio) if gaps[-1] in apart else 0.0)
        return said + (
            f"Usual cause: infinitely many switches in finite time: each takes {ratio:.3g} of the time of the "
            f"one before, so that the motion comes to rest at about t = {end:.6g}.\n"
            'Fix: add a phase of rest, with lj.Switch(..., rest="lying") to go there; or ts that end before.'
        )
    at_once = 1 + int(np.argmax(gaps[::-1] > AT_ONE_TIME * max(abs(last), 1e-300))) if apart.size else count
    if at_once < min(3, count):
        return said + f"Fix: lj.Hybrid(..., most_switches={10 * count}), or ts that end before."
    names = " -> ".join(trajectory.system.names[i] for i in _phases_along(trajectory)[-4:])
    said += f"The last {at_once} of them, {names}, happen at one time"
    before, after = (columns(np, x, rows=len(switches.t))[:count] for x in (switches.v, switches.v_after))
    change, size = np.max(abs(after[-1] - before[-1])), np.max(abs(np.concatenate([before, after])))
    if change > STILL * size:
        return said + (
            f", and still change velocities, the last one by {change:.2g}: impacts that follow each other.\n"
            f"Fix: lj.Hybrid(..., most_switches={10 * count})."
        )
    return said + (
        f", and the last one changes velocities by {change:.1g} only: its guard is at zero, or below, and falls "
        "although nothing moves toward it. No phase lasts.\n"
        "Fix: add a phase for what happens there (a contact that stays, a joint that sticks), with the constraint "
        'that holds it: lj.Switch(..., rest="lying"), or start="lying".'
    )


def _no_state_after(trajectory):
    hybrid, switches = trajectory.system, trajectory.switches
    last = len(switches) - 1
    switch = hybrid.switches[int(switches.way[last])]
    before = f"q = {describe(jax.tree.map(lambda x: x[last], switches.q))}"
    said = (
        f"the switch {switch.in_words()} at t = {float(switches.t[last]):.9g} gives a state that is not finite, from "
        f"{before}.\n"
    )
    if getattr(switch.reset, "friction", None) is not None:
        return said + (
            "Usual cause: a contact that jams. The gap and the constraints fix how it slides, whatever friction does, "
            "and friction exceeds the force that pushes the contact together: no impulse satisfies both.\n"
            "Fix: less friction, or a plastic impact onto a phase in which the contact holds: lj.guards.touches(gap)."
        )
    return said + (
        "Usual cause: a reset that divides by something that is zero there, or takes its root; or constraints of the "
        "next phase that cannot be satisfied.\n"
        "Fix: look at reset(t, q, v, params) at that state, in traj.switches with throw=False."
    )


def _not_seen(trajectory, settings: Settings):
    """The guards that are below zero at the end of the last phase, which is integrated without them."""
    hybrid, end, i = trajectory.system, trajectory.end, trajectory.last_phase()
    ts = np.array([end.t, trajectory.t[-1]], np.asarray(trajectory.t).dtype)
    alone = trajectory.static.integrate(Problem(hybrid.systems[i], end.q, end.v, trajectory.params, ts, None, settings))
    values = {}
    for switch in (hybrid.switches[k] for k in hybrid.leaving(i)):

        def of(at, switch=switch):
            return float(switch.value(at.t, at.q, at.v, at.multipliers, trajectory.params))

        values[switch.in_words()] = of(end), of(alone.end)
    below = {name: pair for name, pair in values.items() if not pair[1] >= 0}
    said = "; ".join(f"that of {name} is {g1:.3g}, and {g0:.3g} at the start" for name, (g0, g1) in below.items())
    return f": {said}" if said else ""


def _phases_along(trajectory):
    switches, hybrid = trajectory.switches, trajectory.system
    return [int(hybrid.first), *map(int, np.asarray(switches.to)[: len(switches)])]


def _switches_below(hybrid: Hybrid, start: State) -> list[str]:
    """The guards of switches of the first phase that are below zero at the start, in words."""
    first, found = int(hybrid.first), []
    system = hybrid.systems[first]
    # The multipliers of elements depend on their modes.
    known = hybrid.elements is None and bool(system.constraints)
    multipliers = accelerations(system, *start)[1] if known else {}
    for i in hybrid.leaving(first):
        switch = hybrid.switches[i]
        if not known and takes_of(switch.when) != OF_STATE:
            continue
        value = switch.value(start.t, start.q, start.v, multipliers, start.params)
        if float(value) < 0:
            found.append(f"that of {switch.in_words()} is {float(value):.6g}")
    return found


def _below_zero(hybrid: Hybrid, start: State):
    name, found = hybrid.names[int(hybrid.first)], "; ".join(_switches_below(hybrid, start))
    return (
        f"a guard of phase '{name}' is below zero at the start: {found}.\n"
        "Usual cause: a motion that starts in the wrong phase, or a guard with the wrong sign: it must be above zero "
        "as long as the phase lasts.\n"
        "Fix: lj.integrate(..., start=name), or -guard."
    )


def warn_of_events(trajectory, guards) -> None:
    """Warn if crossings may be missing, and if there were more than are kept; `guards`: those of each phase."""
    for name, found in trajectory.events.items():
        if bool(found.uncertain):
            which, cause, fix = in_doubt(trajectory, guards, name)
            warn(f"crossings of {which} may be missing: its guard {cause or UNKNOWN}.\nFix: {fix}.", EventWarning)
        elif int(found.count) > found.t.shape[-1] > 1:
            warn(
                f"event '{name}' happened {int(found.count)} times, but only the first {found.t.shape[-1]} are kept.\n"
                f"Fix: lj.Crossing(..., most={int(found.count)}), or terminal=True to end at the first.",
                EventWarning,
            )


def warn_of_missed_end(trajectory, guards) -> bool:
    """Whether the second, more precise motion ended at an event that this one did not see: then warn of that."""
    error = trajectory.error
    if error is None or not is_among(error.result, [RESULTS.event_occurred]):
        return False
    if is_among(trajectory.result, [RESULTS.event_occurred]):
        return False
    of_phases = [guards] if isinstance(guards, Guards) else [phase.guards for phase in guards or () if phase.guards]
    names = dict.fromkeys(f"'{kind.name}'" for of in of_phases for kind in of.kinds if kind.terminal)
    warn(
        f"a second motion with other steps ended at an event that this one did not see ({', '.join(names)}): its guard "
        "crosses zero and comes back within a step.\nFix: max_step=, shorter than the guard takes for that.",
        EventWarning,
    )
    return True
