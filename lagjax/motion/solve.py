"""The compiled program behind `integrate`: start, diffrax's loop, outputs.

Nothing here looks at values: a start that cannot be integrated is refused inside the program, which then ends
within a few rejected steps, and the lane keeps the reason in its result.
"""

import importlib.util
from functools import partial

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from lagjax.mechanics import coordinates
from lagjax.mechanics.coordinates import State
from lagjax.mechanics.in_numbers import Numbers, in_numbers
from lagjax.mechanics.saddle_point import equations_of_motion, verdict
from lagjax.mechanics.structure import angles, conserves_jacobi_integral, is_free_of_velocities
from lagjax.mechanics.written_out import is_small, write_out
from lagjax.motion.arriving import Arriving
from lagjax.motion.both_modes import solve_in_both_modes
from lagjax.motion.consistency import stopped, to_manifold, within, worst_residual
from lagjax.motion.sign_change import SignChange
from lagjax.motion.stepping import OnManifold, Quick, Stages, Tolerances, forward_differentiable
from lagjax.motion.trajectory import RESULTS, Moment, Trajectory, ended_well, pack, worst_drift
from lagjax.numerics.nystrom import Nystrom, Nystrom12
from lagjax.numerics.one_function import called, one_function
from lagjax.numerics.runge_kutta import Dopri8, ExplicitRungeKutta
from lagjax.numerics.simplified_newton import SimplifiedNewton, with_tolerances

# A start may be off the constraints by this many tolerances; it is then moved onto them.
START_TOLERANCES = 100.0
# Baumgarte's feedback decays a violation by e this many times over the time span.
BAUMGARTE_DECAYS = 50.0
# A motion of a hundred periods changes the Jacobi integral by ten to a hundred tolerances.
DRIFT_TOLERANCES = 1e3
# The same change times the number of steps is about twenty times the phase that it shifts, in radians: a hundredth.
PHASE_STEPS = 0.2
# With fixed steps no tolerance says how much is expected.
FIXED_STEPS_ALLOW = 1e-5
# The tightest tolerance that is not below round-off.
ROUND_OFFS = 8
# What diffrax reports, in the words of a motion.
TRANSLATED = {
    "nonfinite_input": "not_finite",
    "nonlinear_divergence": "unsolved_step",
    "nonlinear_max_steps_reached": "unsolved_step",
}


# The operations of a right-hand side that is copied to each of the stages; longer ones are compiled once, in a loop.
UNROLL_UP_TO = 250


class Settings(eqx.Module):
    """How to integrate: everything but the system, the state and the times."""

    method: diffrax.AbstractSolver | None
    controller: diffrax.AbstractStepSizeController | None
    event: diffrax.Event | None
    adjoint: diffrax.AbstractAdjoint | None
    rtol: Float[Array, " 2"]
    atol: Float[Array, " 2"]
    dt0: Float[Array, ""] | None
    apart: bool = eqx.field(static=True)
    max_steps: int | None = eqx.field(static=True)
    drift: str = eqx.field(static=True)
    progress: bool = eqx.field(static=True)


@eqx.filter_jit
def trajectory_of(system, q0, v0, params, ts, settings) -> Trajectory:
    """The trajectory, whatever became of it."""
    settings = eqx.tree_at(
        lambda s: s.method, settings, _method(settings, system, ts[0], q0, v0, params), is_leaf=lambda x: x is None
    )
    # Derivatives flow to the floating arrays of these; the settings are constants.
    x, rest = eqx.partition((system, q0, v0, params, ts), eqx.is_inexact_array)
    fixed, static = eqx.partition((rest, settings), eqx.is_array)

    def solved(x, fixed, adjoint):
        rest, settings = eqx.combine(fixed, static)
        return _solve_in_numbers(*eqx.combine(x, rest), settings, adjoint)

    if settings.adjoint is None:
        fields = solve_in_both_modes(solved, x, fixed)
    else:
        fields = solved(x, fixed, settings.adjoint)
    arrays, described = pack(system, params, type(settings.method).__name__)
    tolerance = (settings.rtol, settings.atol)
    return Trajectory(t=ts, **fields, tolerance=tolerance, arrays=arrays, static=described)


def _method(settings, system, *state):
    """The method asked for, if it can do it; by default the fastest that can."""
    chosen = settings.method
    if chosen is None:
        # BacksolveAdjoint integrates a state that is no pair (q, v).
        pairs = not isinstance(settings.adjoint, diffrax.BacksolveAdjoint)
        return Nystrom12() if pairs and is_free_of_velocities(system, *state) else Dopri8()
    if isinstance(chosen, Nystrom) and not is_free_of_velocities(system, *state):
        cause = "there are constraints" if system.constraints else "these do"
        raise ValueError(
            f"{type(chosen).__name__} is for accelerations that do not depend on velocities, and {cause}.\n"
            "Usual cause: coordinates in which the kinetic energy has q in it (polar, joint angles), friction, or a "
            "rotating frame.\n"
            "Fix: method=lj.Dopri8(), or leave method out: it is then chosen."
        )
    return chosen


def _solve_in_numbers(system, q0, v0, params, ts, settings, adjoint):
    """The solve, of a small system with the coordinates one by one."""
    written = unflatten = None
    if isinstance(settings.method, (ExplicitRungeKutta, Nystrom)) and is_small(system, ts[0], q0, v0, params):
        _, unflatten = coordinates.flatten(q0)
        system, q0, v0 = in_numbers(system, unflatten), coordinates.numbers(q0), coordinates.numbers(v0)
        event = settings.event
        if event is not None:
            settings = eqx.tree_at(lambda s: s.event, settings, _event_in_numbers(event, unflatten))
        written = write_out(system, ts[0], q0, v0, params)
    fields = _solve(system, q0, v0, params, ts, settings, adjoint, written)
    if unflatten is None:
        return fields
    end, together = fields["end"], lambda numbers: unflatten(jnp.stack(numbers))
    return fields | {
        "q": jax.vmap(together)(fields["q"]),
        "v": jax.vmap(together)(fields["v"]),
        "end": end._replace(q=together(end.q), v=together(end.v)),
    }


def _solve(system, q0, v0, params, ts, settings, adjoint, written):
    off_constraints = _off_constraints(system, ts[0], q0, v0, params, settings)
    projected = None
    if settings.drift == "project":
        projected = to_manifold(system, ts[0], q0, v0, params, settings.rtol, settings.atol)
        q0, v0 = projected.q, projected.v
    start = stopped(verdict(system, ts[0], q0, v0, params))
    finite, singular, contradictory = start.finite, start.singular, start.contradictory
    if projected is not None:
        off_constraints = off_constraints | (finite & ~singular & ~projected.holds)
    too_small = settings.rtol[0] < ROUND_OFFS * jnp.finfo(ts.dtype).eps if settings.controller is None else False
    backwards = jnp.any(ts[1:] < ts[:-1])
    if settings.dt0 is not None:
        backwards = backwards | ~(settings.dt0 > 0)
    refused = off_constraints | contradictory | singular | ~finite | too_small | backwards
    y0 = jax.tree.map(lambda x: jnp.where(refused, 0.0, x), (q0, v0))
    terms = diffrax.ODETerm(_vector_field(system, ts, settings.drift))
    quick = None
    if written is not None and settings.drift != "baumgarte":
        field = WrittenField(written.equations, written.equations.prepare(system, params))
        project = written.project if settings.drift == "project" else None
        prepared = () if project is None else project.prepare(system, params)
        stages = settings.method if written.equations.length <= UNROLL_UP_TO else _in_a_loop(settings.method, adjoint)
        quick = Quick(stages, diffrax.ODETerm(field), project, prepared, written.careful)
    # BacksolveAdjoint integrates a larger state backwards: it takes the bare method, and no end beside the outputs.
    bare = isinstance(adjoint, diffrax.BacksolveAdjoint)
    settings = eqx.tree_at(lambda s: s.method, settings, _with_root_finder(settings))
    at_ts, at_end = diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)
    if bare:
        solver, saveat = settings.method, diffrax.SaveAt(ts=ts)
    else:
        solver = _solver(system, terms, quick, State(ts[0], q0, v0, params), refused, settings, adjoint)
        saveat = diffrax.SaveAt(subs=(at_ts, at_end))
    solve = partial(_diffeqsolve, max_steps=settings.max_steps, adjoint=adjoint, progress=settings.progress)
    arguments = (
        terms if quick is None else quick.terms, solver, ts[0], ts[-1], settings.dt0, y0, params, saveat,
        _controller(ts, settings, bare), _located_event(settings.event, ts),
    )  # fmt: skip
    # Reverse mode has to look inside.
    if isinstance(adjoint, diffrax.ForwardMode):
        solution = one_function(
            solve, *arguments, checked=_has_no_checks_of_its_own(settings.controller), in_blocks=True
        )
    else:
        solution = solve(*arguments)
    if bare:
        reached_ts, outputs = solution["ts"], solution["ys"]
        end_t, end_y = jax.tree.map(lambda x: x[-1:], (reached_ts, outputs))
    else:
        (reached_ts, end_t), (outputs, end_y) = solution["ts"], solution["ys"]

    # What was not reached is evaluated at the start and masked afterwards: NaN times zero would poison gradients.
    reached = jnp.isfinite(reached_ts) & ~refused
    outputs = jax.tree.map(lambda x, x0: jnp.where(_like(reached, x), x, x0[None]), outputs, (q0, v0))
    # One compiled evaluation for the outputs and the end together.
    t, (q, v) = jax.tree.map(lambda x, last: jnp.concatenate([x, last]), (ts, outputs), (end_t, end_y))
    everything = Moment(t, q, v, _multipliers(system, t, q, v, params))
    end = jax.tree.map(lambda x: jnp.where(refused, jnp.nan, x[-1]), everything)._replace(t=t[-1])
    _, q, v, multipliers = jax.tree.map(lambda x: jnp.where(_like(reached, x), x[:-1], jnp.nan), everything)

    result = RESULTS.promote(solution["result"])
    for reported, ours in TRANSLATED.items():
        result = RESULTS.where(result == getattr(RESULTS, reported), getattr(RESULTS, ours), result)
    # An output is a step of its own, and can fail where the steps of the solve did not.
    all_reached = jnp.all(jnp.isfinite(coordinates.flatten(outputs)[0]))
    result = RESULTS.where(ended_well(result) & ~all_reached, RESULTS.unsolved_step, result)
    result = RESULTS.where(singular, RESULTS.start_singular, result)
    result = RESULTS.where(finite, result, RESULTS.start_not_finite)
    result = RESULTS.where(contradictory, RESULTS.contradictory, result)
    result = RESULTS.where(off_constraints, RESULTS.start_off_constraints, result)
    result = RESULTS.where(too_small, RESULTS.tolerance_too_small, result)
    result = RESULTS.where(backwards, RESULTS.backwards, result)
    stats = {name: jnp.asarray(count) for name, count in solution["stats"].items() if name != "max_steps"}
    departure = _departure(system, stopped((t, everything.q, everything.v, params)), stats, settings)
    return {
        "q": q,
        "v": v,
        "multipliers": multipliers,
        "end": end,
        "stats": stats,
        "departure": departure,
        "result": result,
    }


def _diffeqsolve(terms, solver, t0, t1, dt0, y0, args, saveat, controller, event, *, max_steps, adjoint, progress):
    solution = diffrax.diffeqsolve(
        terms, solver, t0, t1, dt0, y0, args, saveat=saveat, stepsize_controller=controller, adjoint=adjoint,
        event=event, max_steps=max_steps, throw=False, progress_meter=_progress_meter(progress),
    )  # fmt: skip
    return {name: getattr(solution, name) for name in ("ts", "ys", "stats", "result")}


def _has_no_checks_of_its_own(controller):
    # diffrax's own are about the times and the first step, which `_solve` looks at.
    return controller is None or isinstance(controller, (diffrax.ConstantStepSize, diffrax.PIDController))


def _departure(system, motion, stats, settings):
    """How far what must stay constant has changed at the outputs, in units of what the tolerance lets expect.

    An error of the Jacobi integral that grows steadily shifts the phase by about its size a radian, so that over very
    many steps less of it is allowed. With steps that the tolerance does not choose it counts for itself.
    """
    t, q, v, params = motion
    drift = residual = jnp.zeros_like(t[0])
    if conserves_jacobi_integral(system, t[0], *jax.tree.map(lambda x: x[0], (q, v)), params):
        drift = worst_drift(system, t, q, v, params)
    if system.constraints and settings.drift != "project":
        residual = worst_residual(system, t, q, v, params)
    if settings.controller is not None:
        return jnp.maximum(drift, residual) / FIXED_STEPS_ALLOW
    rtol = jnp.maximum(settings.rtol[0], jnp.finfo(t.dtype).eps)
    phase = drift * stats["num_accepted_steps"] / PHASE_STEPS
    return jnp.maximum(jnp.maximum(drift, residual) / (DRIFT_TOLERANCES * rtol), phase)


def _vector_field(system, ts, drift):
    """d(q, v)/dt = (v, a), on the user's pytrees."""
    rate = BAUMGARTE_DECAYS / (ts[-1] - ts[0]) if drift == "baumgarte" else None

    def field(t, y, args):
        q, v = y
        params, independent = args if isinstance(args, Stages) else (args, None)
        return v, called(equations_of_motion(system, t, q, v, params, rate, independent))[0]

    return field


class WrittenField(eqx.Module):
    """The same from the equations written out, with what does not depend on the state computed before."""

    equations: Numbers = eqx.field(static=True)
    prepared: tuple

    def __call__(self, t, y, params):
        q, v = y
        return v, called(self.equations.at(self.prepared, t, q, v))[0]


def _event_in_numbers(event, unflatten):
    def wrap(condition):
        def of_numbers(t, y, *args, **kwargs):
            return condition(t, tuple(unflatten(jnp.stack(x)) for x in y), *args, **kwargs)

        return of_numbers

    return diffrax.Event(jax.tree.map(wrap, event.cond_fn, is_leaf=callable), event.root_finder, event.direction)


def _multipliers(system, t, q, v, params):
    at = lambda t, q, v: equations_of_motion(system, t, q, v, params)[1]
    return jax.vmap(at)(t, q, v) if system.constraints else {}


def _off_constraints(system, t, q, v, params, settings):
    if not system.constraints:
        return jnp.asarray(False)
    return ~within(system, t, q, v, params, START_TOLERANCES * settings.rtol, START_TOLERANCES * settings.atol)


def _with_root_finder(settings):
    """An implicit method with diffrax's default root finder gets ours; all get the solve's tolerances."""
    method, tolerances = settings.method, (settings.rtol[0], settings.atol[0])
    if isinstance(getattr(method, "root_finder", None), diffrax.VeryChord):
        return eqx.tree_at(lambda method: method.root_finder, method, SimplifiedNewton(*tolerances))
    return with_tolerances(method, *tolerances)


def _solver(system, terms, quick, start, refused, settings, adjoint):
    angle = tuple(jax.tree.leaves(angles(system, *start)))
    return OnManifold(
        solver=_in_a_loop(settings.method, adjoint),
        system=system,
        terms=terms,
        quick=quick,
        params=start.params,
        refused=refused,
        tolerances=Tolerances(settings.rtol, settings.atol),
        angles=angle,
        controlled=settings.controller is None,
        weigh=settings.controller is None and (settings.apart or any(angle)),
        project=settings.drift == "project",
        arriving=_arriving(settings),
    )


def _in_a_loop(method, adjoint):
    """The method with a loop over its stages, of the kind that the derivative needs."""
    if isinstance(method, Nystrom):
        return type(method)(in_a_loop=True)
    ours = isinstance(method, ExplicitRungeKutta)
    method = method.shipped if ours else method
    if isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint):
        return forward_differentiable(method)
    return eqx.tree_at(lambda s: s.scan_kind, method, "lax", is_leaf=lambda x: x is None) if ours else method


def _arriving(settings):
    # An event is looked for inside its step, and a controller of the user's chooses its steps itself.
    return settings.controller is None and settings.event is None


def _controller(ts, settings, bare):
    if settings.controller is not None:
        return settings.controller
    # A step that small no longer moves t: the solution is singular there, or was NaN from the start.
    dtmin = 16 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    # The largest error counts, not the mean: more coordinates should not loosen the tolerance of each.
    controller = diffrax.PIDController(
        rtol=settings.rtol[0], atol=settings.atol[0], norm=optx.max_norm, dtmin=dtmin, force_dtmin=False
    )
    return Arriving(controller, ts) if _arriving(settings) and not bare else controller


def _located_event(event, ts):
    """The user's event, located to round-off in t where no root finder is named."""
    if event is None:
        return None
    tolerance = 4 * jnp.finfo(ts.dtype).eps * jnp.maximum(jnp.abs(ts[0]), jnp.abs(ts[-1]))
    finder = SignChange(rtol=0.0, atol=tolerance) if event.root_finder is None else event.root_finder
    # diffrax passes `args` by keyword; by position the user may call it `params`.
    by_position = lambda condition: lambda t, y, args, **kwargs: condition(t, y, args, **kwargs)
    return diffrax.Event(jax.tree.map(by_position, event.cond_fn, is_leaf=callable), finder, event.direction)


def _progress_meter(progress):
    if not progress:
        return diffrax.NoProgressMeter()
    if importlib.util.find_spec("tqdm") is None:
        return diffrax.TextProgressMeter()
    return diffrax.TqdmProgressMeter()


def _like(mask, x):
    return mask.reshape(mask.shape + (1,) * (x.ndim - 1))
