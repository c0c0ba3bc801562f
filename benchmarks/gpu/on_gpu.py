"""How fast, how large and how accurate is a batch of motions as one program, on a GPU or a CPU?

    beads      on the rotating hoop, each at its own speed of the hoop; from rest at 1 rad, against elliptic functions
    network    the same beads with a network of 49 weights in their potential; the gradient is with respect to these, by
               replaying steps backwards. Against diffrax by hand at a tolerance of 1e-12
    rods       point masses in Cartesian coordinates, each on its own rod with its multiplier, against the same
               functions

"motions" is the state at the end, "gradient" is that of the sum of its squares: with respect to g, a and each bead's ω,
to the network, or to g and each rod's length. lagjax uses `jax.vmap` of `lj.integrate`; the comparison is diffrax's
Dopri8 as shipped with the accelerations derived by hand. Each is measured in a separate process, at the loosest
tolerance of a ladder below which `SAMPLE` of the lanes are within `ERROR`: motions in radians, gradients relative to
their largest number.

    ours / diffrax          times of later calls; the first call, with its compilation, is given too
    memory                  the peak reported by the device over the memory that the compiled program states beforehand
    operations on the host  in the compiled program (`host_operations.py`), and in one with a `jax.debug.callback`
    single precision        a tolerance that float32 cannot reach is refused; at the tightest allowed one: the error
                            over it, and the number of motions that are worse than a scaled_error of 1 allows without
                            saying so

It is meant for a machine with one GPU; `--small` is for any other machine, and for the tests. Float64 is always
enabled: the arrays select float32.

    python -m benchmarks.gpu.on_gpu [--small] [--json FILE] [--only TEXT]
"""

import functools
import os
import time
import warnings
from typing import NamedTuple

# Measurements run one after the other and need the whole device, so none may reserve memory that it does not use.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import diffrax  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import lagjax as lj  # noqa: E402
from benchmarks.gpu.host_operations import host_operations, with_a_look  # noqa: E402
from benchmarks.measure import CLOCK, in_new_process, main, row, skipped, small  # noqa: E402
from lagjax.integrate.results import EXPECTED  # noqa: E402
from lagjax.scenes import bead_on_hoop  # noqa: E402

jax.config.update("jax_enable_x64", True)

END, START, SAMPLE, REPEATS, EXACT = 10.0, 1.0, 64, 9, 1e-12
ERROR = {"float64": {"motions": 1e-7, "gradient": 1e-5}, "float32": {"motions": 1e-3, "gradient": 1e-2}}
# Half decades, down to the limit of each dtype.
TOLERANCES = {"float64": np.geomspace(1e-3, 1e-12, 19), "float32": np.geomspace(1e-2, 10**-5.5, 8)}
GRAVITY, RADIUS, NEURONS = 9.8125, 0.75, 12
LANES = {"beads": 100_000, "network": 100_000, "rods": 10_000}
SMALL = {"beads": 256, "network": 128, "rods": 128}
OPTIONS = {"small": False}


class Problem(NamedTuple):
    """One motion with parameters `p` (shared by all lanes) and `x` (of its lane), as L and as a field by hand.

    `start(p, x)` is q and v; `exact(p, x)` the state at the end, or None; `weigh` converts a state to radians.
    """

    system: lj.System
    field: object
    start: object
    exact: object
    p: dict
    x: object
    weigh: object


def network(p, psi):
    """One hidden layer in sin ψ and cos ψ; its gradient has more than 24 numbers."""
    return jnp.dot(p["out"], jnp.tanh(p["sin"] * jnp.sin(psi) + p["cos"] * jnp.cos(psi) + p["shift"])) + p["top"]


def weights():
    """The 49 weights of the network; its output is small compared with m g a."""
    random = np.random.default_rng(0)
    of = lambda size: size * random.normal(size=NEURONS)
    return {"out": of(0.1), "sin": of(1.0), "cos": of(1.0), "shift": of(0.3), "top": np.array(0.0)}


def bead_lagrangian(t, q, v, params):
    """The scene's L with m = 1, and the network, if there is one, as a potential."""
    added = network(params["network"], q) if "network" in params else 0.0
    return bead_on_hoop.lagrangian(t, q, v, params | {"m": 1.0}) - added


def bead_field(t, y, params):
    """The acceleration derived by hand, with the derivative of the network by `jax.grad`."""
    psi, rate = y
    a = params["a"]
    acceleration = jnp.sin(psi) * (params["omega"] ** 2 * jnp.cos(psi) - params["g"] / a)
    if "network" in params:
        acceleration -= jax.grad(network, 1)(params["network"], psi) / a**2
    return rate, acceleration


def rod_field(t, y, params):
    """r̈ = -g ŷ + λ r, and d²(r²)/dt² = 0 gives λ = (g y - v²) / r²."""
    r, v = y
    pull = (params["g"] * r[1] - jnp.sum(v**2)) / jnp.sum(r**2)
    return v, pull * r - params["g"] * jnp.array([0.0, 1.0], r.dtype)


def rod_exact(p, x):
    """The motion of a bead on a hoop at rest, in Cartesian coordinates."""
    psi, rate = bead_on_hoop.exact_motion(p | {"a": x, "omega": 0.0}, START, END)
    out, along = jnp.stack([jnp.sin(psi), -jnp.cos(psi)]), jnp.stack([jnp.cos(psi), jnp.sin(psi)])
    return x * out, x * rate * along


def problem(name, lanes):
    """A case with its lanes."""
    natural = np.sqrt(GRAVITY / RADIUS)
    if name == "rods":
        rod = lj.Holonomic(lambda t, q, p: jnp.sum(q**2) - p["x"] ** 2)
        system = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - p["g"] * q[1], {"rod": rod})
        at = lambda p, x: (x * jnp.stack([jnp.sin(START), -jnp.cos(START)]).astype(x.dtype), jnp.zeros(2, x.dtype))
        weigh = lambda p, x: (1 / x, 1 / (x * natural))
        return Problem(system, rod_field, at, rod_exact, {"g": np.array(GRAVITY)}, np.linspace(0.5, 2.0, lanes), weigh)
    # The homoclinic orbit through START is at 1 / cos(START / 2) = 1.14: near it neighbouring motions separate.
    speeds = np.concatenate([np.linspace(0.5, 1.0, lanes // 2), np.linspace(1.3, 3.0, lanes - lanes // 2)])
    p = {"g": np.array(GRAVITY), "a": np.array(RADIUS)} | ({"network": weights()} if name == "network" else {})
    at = lambda p, x: (jnp.full((), START, x.dtype), jnp.zeros((), x.dtype))
    exact = None if name == "network" else lambda p, x: bead_on_hoop.exact_motion(p | {"omega": x}, START, END)
    weigh = lambda p, x: (1.0, 1 / natural)
    return Problem(lj.System(bead_lagrangian), bead_field, at, exact, p, natural * speeds, weigh)


def named(p, x):
    """All parameters of a lane by name: `x` is a bead's ω, or a rod's length."""
    return p | ({"omega": x} if "a" in p else {"x": x})


def by_lagjax(case, tolerance, p, x, **settings):
    """The trajectory of one lane."""
    return lj.integrate(
        case.system, *case.start(p, x), named(p, x), ts=np.array([0.0, END], x.dtype), rtol=tolerance, atol=tolerance,
        throw=False, **settings,
    )  # fmt: skip


def end_of_ours(case, tolerance, p, x):
    """The last state of one lane."""
    trajectory = by_lagjax(case, tolerance, p, x)
    return jax.tree.map(lambda y: y[-1], (trajectory.q, trajectory.v))


def end_by_hand(case, tolerance, p, x):
    """The final state by diffrax with its defaults and the field by hand."""
    ys = diffrax.diffeqsolve(
        diffrax.ODETerm(case.field), diffrax.Dopri8(), 0.0, END, None, case.start(p, x), args=named(p, x),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance), max_steps=4096,
        throw=False,
    ).ys  # fmt: skip
    return jax.tree.map(lambda y: y[-1], ys)


def of_all(case, end, what):
    """`program(tolerance, p, x)`: the ends of all lanes as one program, or the gradient of the sum of their squares."""
    lanes = jax.vmap(lambda tolerance, p, x: end(case, tolerance, p, x), (None, None, 0))
    if what == "motions":
        return lanes
    size = lambda tolerance, p, x: sum(jnp.sum(y**2) for y in jax.tree.leaves(lanes(tolerance, p, x)))
    # In the case with a network, the gradient is with respect to the network.
    if "network" in case.p:
        known = {name: value for name, value in case.p.items() if name != "network"}
        of_network = lambda tolerance, learned, x: size(
            tolerance, jax.tree.map(lambda y: jnp.asarray(y, x.dtype), known) | {"network": learned}, x
        )
        return lambda tolerance, p, x: jax.grad(of_network, 1)(tolerance, p["network"], x)
    return jax.grad(size, (1, 2))


def sample_of(case):
    """The same case with a few of its lanes."""
    chosen = np.unique(np.linspace(0, len(case.x) - 1, SAMPLE).astype(int))
    return case._replace(x=case.x[chosen])


def reference(case, what):
    """The reference in float64: the closed form, or diffrax at its tightest tolerance."""
    right = end_by_hand if case.exact is None else lambda case, tolerance, p, x: case.exact(p, x)
    if case.exact is None or what == "motions":
        return jax.jit(of_all(case, right, what))(EXACT, case.p, case.x)
    # Forward mode in each lane: the arithmetic-geometric mean is unsuitable for reverse mode.
    square = lambda p, x: sum(jnp.sum(y**2) for y in case.exact(p, x))
    by_p, by_x = jax.jit(jax.vmap(jax.jacfwd(square, (0, 1)), (None, 0)))(case.p, case.x)
    return jax.tree.map(lambda y: jnp.sum(y, axis=0), by_p), by_x


def error(case, what, found, right):
    """The largest error: of a state in radians, of each number of a gradient relative to the largest of its kind."""
    if what == "gradient":
        of = lambda a, b: np.max(np.abs(np.asarray(a, float) - b)) / np.max(np.abs(b)) if np.any(b) else 0.0
        # A network's last bias does not affect the motion, so its numbers are judged together.
        if "network" in case.p:
            found, right = (np.concatenate([np.ravel(y) for y in jax.tree.leaves(x)]) for x in (found, right))
        return float(max(map(of, jax.tree.leaves(found), jax.tree.leaves(right))))
    return float(max(map(np.max, in_radians(case, found, right))))


def in_radians(case, found, right):
    """The errors of all lanes' positions and velocities."""
    weights = case.weigh(case.p, case.x)
    size = lambda a, b: np.abs(np.asarray(a, float) - b).reshape(len(case.x), -1).max(axis=1)
    return [size(a, b) * weight for a, b, weight in zip(found, right, weights)]


def settled(case, dtype, what, who):
    """(tolerance, error): the loosest tolerance below which the sample is within `ERROR`, or the tightest."""
    few = sample_of(case)
    program, right = jax.jit(of_all(few, who, what)), reference(few, what)
    arguments = in_dtype((few.p, few.x), dtype)
    before = None
    for tolerance in TOLERANCES[dtype]:
        found = error(few, what, program(jnp.asarray(tolerance, dtype), *arguments), right)
        if found <= ERROR[dtype][what] and before is not None:
            return before
        before = (float(tolerance), found) if found <= ERROR[dtype][what] else None
    return before or (float(tolerance), found)


def in_dtype(tree, dtype):
    """The tree in a dtype, on the device."""
    return jax.tree.map(lambda y: jnp.asarray(y, dtype), tree)


def measured(name, dtype, what, who, small=False, clock="perf_counter"):
    """Seconds, bytes and host operations of one program in this process; its tolerance and error on the sample."""
    now = getattr(time, clock)
    case = problem(name, (SMALL if small else LANES)[name])
    end = {"lagjax": end_of_ours, "diffrax": end_by_hand}[who]
    tolerance, wrong = settled(case, dtype, what, end)
    arguments = jnp.asarray(tolerance, dtype), *in_dtype((case.p, case.x), dtype)
    started = now()
    program = jax.jit(of_all(case, end, what)).lower(*arguments).compile()
    jax.block_until_ready(program(*arguments))
    first, times = now() - started, []
    for _ in range(REPEATS):
        started = now()
        found = jax.block_until_ready(program(*arguments))
        times.append(now() - started)
    stated = program.memory_analysis()
    reported = jax.devices()[0].memory_stats() or {}
    looked_at = jax.jit(with_a_look(of_all(sample_of(case), end, what))).lower(*arguments[:2], arguments[2][:SAMPLE])
    return {
        "first": first, "next": float(np.median(times)), "tolerance": tolerance, "error": wrong, "lanes": len(case.x),
        "stated_MB": 1e-6 * sum(getattr(stated, f"{of}_size_in_bytes") for of in ("argument", "output", "temp")),
        "reported_MB": 1e-6 * reported["peak_bytes_in_use"] if "peak_bytes_in_use" in reported else None,
        "reached": wrong <= ERROR[dtype][what],
        "finite": bool(all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))),
        "host": len(host_operations(program.as_text())),
        "host_if_looked_at": len(host_operations(looked_at.compile().as_text())),
        "device": str(jax.devices()[0].device_kind),
    }  # fmt: skip


def single_precision(name, small=False):
    """Float32: whether unreachable tolerances are refused; the tightest allowed one, its error, and silent lanes."""
    case = sample_of(problem(name, (SMALL if small else LANES)[name]))
    p, x = in_dtype((case.p, case.x), "float32")
    try:
        by_lagjax(case, 1e-9, p, x[0])
        refused = ""
    except ValueError as error:
        refused = str(error).splitlines()[0]
    tolerance = float(TOLERANCES["float32"][-1])
    lanes = jax.vmap(functools.partial(by_lagjax, case, estimate_error=True), (None, None, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = jax.jit(lanes)(jnp.asarray(tolerance, "float32"), p, x)
    right = reference(case, "motions")
    worst = np.max(in_radians(case, jax.tree.map(lambda y: y[:, -1], (found.q, found.v)), right), axis=0)
    reported = np.asarray(found.scaled_error) > 1
    return {
        "refused": refused, "tolerance": tolerance, "error": float(np.max(worst)),
        # An estimate may be off by a factor of ten.
        "silent": int(np.sum((worst > 10 * EXPECTED * tolerance) & ~reported)), "said": int(np.sum(reported)),
        "lanes": len(case.x),
    }  # fmt: skip


def elsewhere(function, *arguments):
    """Run `function` of this module in a separate process."""
    return in_new_process(
        f"import json\nfrom benchmarks.gpu import on_gpu\nprint(json.dumps(on_gpu.{function}(*{arguments!r})))"
    )


def rows(wanted):
    """Each case in both precisions; then the checks of single precision."""
    small = OPTIONS["small"]
    clock = "process_time" if CLOCK["seconds"] is time.process_time else "perf_counter"
    cases = [
        (name, what) for name in LANES for what in ("motions", "gradient") if (name, what) != ("network", "motions")
    ]
    for name, what in cases:
        for dtype in ERROR:
            title = f"{(SMALL if small else LANES)[name]:,} {name}, {dtype}, {what}"
            if wanted(title):
                yield from beside(title, *(elsewhere("measured", name, dtype, what, who, small, clock)
                                           for who in ("lagjax", "diffrax")))  # fmt: skip
    for name in ("beads", "rods"):
        title = f"single precision, {name}"
        if wanted(title):
            found = elsewhere("single_precision", name, small)
            yield row(f"{title}: 1e-9 refused", bool(found["refused"]), 1, better="more", words=found["refused"])
            yield row(
                f"{title}: error / tightest tolerance", found["error"] / found["tolerance"], EXPECTED,
                tolerance=found["tolerance"], error=found["error"],
            )  # fmt: skip
            yield row(f"{title}: silent", found["silent"], 0, told=found["said"], lanes=found["lanes"])


def beside(title, ours, theirs):
    """The rows of one case."""
    if not (ours["reached"] and ours["finite"]):
        yield row(f"{title}: right to what is asked for", 0, 1, better="more", error=ours["error"])
    # If diffrax does not reach the error, its time says nothing.
    target = 1.0 if theirs["reached"] else None
    yield row(
        f"{title}: ours / diffrax", ours["next"] / theirs["next"], target, ms=1e3 * ours["next"],
        diffrax_ms=1e3 * theirs["next"], first_s=ours["first"], diffrax_first_s=theirs["first"], error=ours["error"],
        diffrax_error=theirs["error"], tolerance=ours["tolerance"], diffrax_tolerance=theirs["tolerance"],
        device=ours["device"],
    )  # fmt: skip
    memory, shown = f"{title}: memory, reported / stated", {"MB": ours["stated_MB"], "diffrax_MB": theirs["stated_MB"]}
    if ours["reported_MB"] is None:
        yield skipped(memory, "this device does not report its memory; stated are "
                      f"{ours['stated_MB']:.3g} MB, {theirs['stated_MB']:.3g} of diffrax")  # fmt: skip
    else:
        yield row(memory, ours["reported_MB"] / ours["stated_MB"], 1.25, **shown)
    yield row(f"{title}: operations on the host", ours["host"], 0, diffrax=theirs["host"])
    yield row(f"{title}: on the host, if looked at", ours["host_if_looked_at"], 1, better="more")


if __name__ == "__main__":
    OPTIONS["small"] = small()
    main(rows, __doc__)
