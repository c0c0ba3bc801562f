"""Why a motion with elements ended: which contact, and by the numbers that show it.

With the rows A of contacts, the mass matrix M, and constraints that always hold, W = A M⁻¹ Aᵀ (reduced by them) is how
fast each gap and each sliding velocity accelerates by a unit of each force. A contact with the normal force λ that
slides to the side s = ±1 has the friction -s μ λ, and opens by

    (W_NN - s μ W_NT) λ

so that above μ = W_NN / (s W_NT) its force closes it: then no λ keeps a gap closed that would close without it.

Source: Painlevé, C. R. Acad. Sci. Paris 121 (1895) 112; Génot & Brogliato, Eur. J. Mech. A/Solids 18 (1999) 653.
"""

from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from lagjax.integrate.arguments import REFUSED, check_finite
from lagjax.integrate.results import RESULTS, is_among, message
from lagjax.mechanics import consistent_state, describe, explain_failure, listed
from lagjax.system import Holonomic, State, System, constraints, coordinates, model_of

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
