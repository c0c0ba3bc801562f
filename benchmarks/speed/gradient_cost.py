"""What does a gradient cost compared with a solve?

The bead on a rotating hoop, 20 periods, solved by `diffrax`'s Dopri8 as shipped with the acceleration derived by hand,
and by our default method from the Lagrangian: each at the loosest tolerance below which it is within 1e-7 of Jacobi's
elliptic functions at the end. Four derivatives: with respect to g, a, ω and the angle of release.

    forward mode   d(ψ, ψ') at the end by `jax.jacfwd`
    reverse mode   of the sum of the squares of ψ and ψ' at 100 outputs by `jax.grad`

"error" is relative to derivatives of the closed form, which are first checked against its central differences. For
comparison there are diffrax's own gradients, by `ForwardMode` and by its default adjoint. The programs of a mode run
alternately; ratios are medians over the turns.

With networks in L (`networks.py`) of a thousand and of twenty thousand numbers: the first gradient and later ones,
compared with our own solve and with diffrax's gradient, each in a separate process. On one core:

    taskset -c 0 python -m benchmarks.speed.gradient_cost --only numbers

    python -m benchmarks.speed.gradient_cost [--json FILE] [--only TEXT]
"""

import time

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from benchmarks.learned.networks import PROBLEMS
from benchmarks.measure import CLOCK, in_new_process, in_turn, main, row
from benchmarks.speed.against_peers import loosest
from lagjax.scenes import bead_on_hoop

jax.config.update("jax_enable_x64", True)

PERIODS, OUTPUTS, ERROR, REPEATS = 20, 100, 1e-7, 15
# The motion does not depend on m.
PARAMS = {name: bead_on_hoop.PARAMS[name] for name in ("g", "a", "omega")} | {"psi": 1.0}
MASS = bead_on_hoop.PARAMS["m"]
END = PERIODS * float(bead_on_hoop.exact_period(bead_on_hoop.PARAMS, PARAMS["psi"]))
ALL_TS, END_TS = np.linspace(0.0, END, OUTPUTS), np.array([0.0, END])


def exact(params, ts):
    """ψ and ψ' in closed form."""
    return bead_on_hoop.exact_motion(params | {"m": MASS}, params["psi"], ts)


def by_lagjax(tolerance, params, ts, adjoint=None):
    """ψ and ψ' from the Lagrangian."""
    trajectory = lj.integrate(
        bead_on_hoop.system, params["psi"], jnp.zeros(()), params | {"m": MASS}, ts=ts, rtol=tolerance, atol=tolerance,
        adjoint=adjoint, throw=False,
    )  # fmt: skip
    return trajectory.q, trajectory.v


def by_diffrax(tolerance, params, ts, adjoint=None):
    """ψ and ψ' by diffrax as a user would: the acceleration by hand, everything else at its default."""

    def field(t, y, params):
        below = params["g"] / params["a"]
        return y[1], jnp.sin(y[0]) * (params["omega"] ** 2 * jnp.cos(y[0]) - below)

    return diffrax.diffeqsolve(
        diffrax.ODETerm(field), diffrax.Dopri8(), ts[0], ts[-1], None, (params["psi"], jnp.zeros(())), args=params,
        saveat=diffrax.SaveAt(ts=ts), stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        adjoint=diffrax.RecursiveCheckpointAdjoint() if adjoint is None else adjoint, max_steps=2**14,
    ).ys  # fmt: skip


def end_state(motion):
    """The final ψ and ψ' of `motion(params, ts)`, as a function of the parameters."""
    return lambda params: jnp.stack([x[-1] for x in motion(params, END_TS)])


def misfit(motion):
    """The sum of squares at all outputs."""
    return lambda params: sum(jnp.sum(x**2) for x in motion(params, ALL_TS))


# The differentiated quantity, the JAX transformation, and diffrax's adjoint for it.
MODES = {
    "forward": (end_state, jax.jacfwd, diffrax.ForwardMode()),
    "reverse": (misfit, jax.grad, diffrax.RecursiveCheckpointAdjoint()),
}


def true_derivatives(mode):
    """The derivatives of the closed form; refused if its central differences disagree."""
    measure, derive, _ = MODES[mode]
    function = jax.jit(measure(exact))
    found = jax.jit(derive(measure(exact)))(PARAMS)
    for name, value in PARAMS.items():
        step = 1e-5 * value
        ahead, behind = (function(PARAMS | {name: value + sign * step}) for sign in (1, -1))
        if not np.allclose((ahead - behind) / (2 * step), found[name], rtol=1e-6, atol=1e-6):
            raise ArithmeticError(f"the closed form's derivative by {name} is not its difference quotient")
    return found


def relative_error(found, right):
    """The largest difference, relative to each derivative's largest entry."""
    return max(float(np.max(np.abs(found[name] - right[name])) / np.max(np.abs(right[name]))) for name in right)


def program(solve, measure=None, derive=None, adjoint=None, ts=END_TS):
    """A compiled solve, or a derivative of `measure` of it; both take tolerance and parameters."""

    def run(tolerance, params):
        motion = lambda params, ts: solve(tolerance, params, ts, adjoint)
        return derive(measure(motion))(params) if measure else motion(params, ts)

    compiled, params = jax.jit(run), jax.tree.map(jnp.asarray, PARAMS)
    return lambda tolerance: lambda: compiled(jnp.asarray(tolerance), params)


def tolerance_of(solve):
    """The loosest tolerance below which the error at the end is at most `ERROR`."""
    right = np.array(end_state(exact)(PARAMS))
    rate = END / PERIODS / (2 * np.pi)
    error = lambda state: float(np.max(np.abs(np.array([x[-1] for x in state]) - right) * [1.0, rate]))
    return loosest(program(solve), error, ERROR)[1]


def rows(wanted):
    """Gradients with respect to four parameters, and to networks."""
    yield from by_parameters(wanted)
    for name, problem in PROBLEMS.items():
        if wanted(name):
            yield from by_network(name, problem)


def by_network(name, problem):
    """Our gradient of a motion with a network in L, compared with our solve and with diffrax's gradient."""
    clock = "process_time" if CLOCK["seconds"] is time.process_time else "perf_counter"
    run = lambda who: in_new_process(
        "import json\nfrom benchmarks.learned.networks import measured\n"
        f"print(json.dumps(measured({name!r}, {who!r}, clock={clock!r})))"
    )
    ours = run("lagjax")
    target = 4.0 if problem.kind == "rod" else 3.5 if problem.lanes else 3.0
    shown = {"ms": 1e3 * ours["next"], "error": ours["error"], "rtol": ours["rtol"], "MB": ours["MB"]}
    yield row(f"{name}: gradient / our solve", ours["next"] / ours["solve"], target, **shown)
    if problem.kind == "rod":
        yield row(f"{name}: first gradient, s", ours["first"])
        return
    theirs = run("diffrax")
    theirs_shown = {"diffrax_ms": 1e3 * theirs["next"], "diffrax_error": theirs["error"], "diffrax_MB": theirs["MB"]}
    yield row(f"{name}: first gradient / diffrax's", ours["first"] / theirs["first"], 1.0, s=ours["first"])
    target = 0.5 if problem.outputs == 20 else 0.35
    yield row(f"{name}: gradient / diffrax's", ours["next"] / theirs["next"], target, **shown, **theirs_shown)


def by_parameters(wanted):
    """For each mode: our gradient compared with our solve and diffrax's solve, and diffrax's own gradient."""
    names = {mode: f"{mode} mode, {'4 parameters' if mode == 'forward' else f'{OUTPUTS} outputs'}" for mode in MODES}
    if not any(wanted(name) for name in names.values()):
        return
    tolerances = {solve: tolerance_of(solve) for solve in (by_lagjax, by_diffrax)}
    for mode, name in names.items():
        if not wanted(name):
            continue
        measure, derive, adjoint = MODES[mode]
        ts, right = (END_TS if mode == "forward" else ALL_TS), true_derivatives(mode)
        programs = {
            "our gradient": program(by_lagjax, measure, derive)(tolerances[by_lagjax]),
            "our gradient, adjoint named": program(by_lagjax, measure, derive, adjoint)(tolerances[by_lagjax]),
            "our solve": program(by_lagjax, ts=ts)(tolerances[by_lagjax]),
            "diffrax's gradient": program(by_diffrax, measure, derive, adjoint)(tolerances[by_diffrax]),
            "diffrax's solve": program(by_diffrax, ts=ts)(tolerances[by_diffrax]),
        }
        times = in_turn(*programs.values(), repeats=REPEATS)
        place = {program: i for i, program in enumerate(programs)}
        targets = {"our solve": 5.0, "diffrax's solve": 1.5} if mode == "forward" else {"diffrax's solve": 3.0}
        for ours in ("our gradient", "our gradient, adjoint named", "diffrax's gradient"):
            error = relative_error(programs[ours](), right)
            for solve in ("our solve", "diffrax's solve"):
                target = targets.get(solve) if ours == "our gradient" else None
                ratio, of_minima = times.ratio(place[ours], place[solve])
                ms, solve_ms = (1e3 * times.medians[place[which]] for which in (ours, solve))
                yield row(
                    f"{name}: {ours} / {solve}", ratio, target, minima=of_minima, ms=ms, solve_ms=solve_ms, error=error
                )


if __name__ == "__main__":
    main(rows, __doc__)
