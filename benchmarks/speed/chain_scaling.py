"""How do cost and compile time grow with the number of links?

Chains of N links, with a total length of one metre and a total mass of one kilogram, in Cartesian coordinates with one
length constraint per link (open, hung at both ends, closed), a net, and the open chain in absolute angles. For each N
this measures

- one evaluation of the equations of motion, inside a compiled loop, microseconds;
- one step of `lj.integrate` (Dopri8, fixed steps, with its projection), microseconds, with the relative energy error
  and the worst constraint residual;
- the time to trace and compile that integration, seconds.

and the exponent p of cost = N^p, fitted from 16 to 256 links to the least times. Cartesian chains are compared with the
same motion in angles. Each row is the median (the minimum is in another column) of repeated runs in one process.

    python -m benchmarks.speed.chain_scaling [--json FILE] [--only TEXT]
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import diffrax  # noqa: E402
import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import lagjax as lj  # noqa: E402
from benchmarks.measure import compiled, in_turn, main, row  # noqa: E402
from lagjax.mechanics.equations import equations_of  # noqa: E402
from lagjax.system.coordinates import state  # noqa: E402
from lagjax.system.model import model_of

jax.config.update("jax_enable_x64", True)

COUNTS = (2, 4, 8, 16, 64, 256)
FITTED = [16, 256]
GRAVITY = 9.8125
EVALUATIONS, STEPS, REPEATS = 50, 40, 7


def particles(t, q, v, params):
    """Equal particles in a vertical field."""
    return params["m"] * (0.5 * jnp.sum(v**2) - params["g"] * jnp.sum(q[:, 1]))


def lengths(ends):
    """The squared length of each link, for points that hang from `ends[0]`, and from `ends[1]` if it exists."""

    def residual(t, q, params):
        points = jnp.concatenate([ends[0][None], q, *[end[None] for end in ends[1:]]])
        return jnp.sum(jnp.diff(points, axis=0) ** 2, axis=1) - params["l"] ** 2

    return lj.Holonomic(residual)


def parameters(count):
    """One kilogram and one metre in all."""
    return {"m": jnp.asarray(1.0 / count), "l": jnp.asarray(1.0 / count), "g": jnp.asarray(GRAVITY)}


def hanging_angles(count):
    """Absolute angles from the vertical, at rest."""
    return np.linspace(0.3, 1.2, count)


def open_chain(count):
    """Hung at one end, released at rest."""
    angle = hanging_angles(count)
    q = np.cumsum(np.stack([np.sin(angle), -np.cos(angle)], 1), axis=0) / count
    return lj.System(particles, {"links": lengths([np.zeros(2)])}), q, np.zeros_like(q), parameters(count)


def hung_chain(count):
    """Hung at both ends as an arc, released at rest, with one more link than particles."""
    angle = np.linspace(-1.0, 1.0, count + 1)
    points = np.cumsum(np.stack([np.cos(angle), np.sin(angle)], 1), axis=0) / count
    constraint = lengths([np.zeros(2), points[-1]])
    return lj.System(particles, {"links": constraint}), points[:-1], np.zeros((count, 2)), parameters(count)


def closed_chain(count):
    """A turning ring."""
    angle = 2 * np.pi * np.arange(count) / count
    q = np.stack([np.cos(angle), np.sin(angle)], 1) / (2 * count * np.sin(np.pi / count))
    closed = lj.Holonomic(lambda t, q, params: jnp.sum((q - jnp.roll(q, 1, axis=0)) ** 2, axis=1) - params["l"] ** 2)
    return lj.System(particles, {"links": closed}), q, 3.0 * np.stack([-q[:, 1], q[:, 0]], 1), parameters(count)


def net(count):
    """A wavy square net in space of about `count` particles, hung at its upper corners, released at rest."""
    width = round(np.sqrt(count))
    place = np.arange(width**2).reshape(width, width)
    across, down = [place[:, 1:], place[:, :-1]], [place[1:], place[:-1]]
    first, second = (np.concatenate([a.ravel(), d.ravel()]) for a, d in zip(across, down))
    x, y = (part.ravel().astype(float) for part in np.meshgrid(np.arange(width), -np.arange(width)))
    q = np.stack([x + 0.1 * np.sin(y), y, 0.5 * np.sin(x) + 0.3 * np.cos(y)], 1) / width
    squares, left, right = np.sum((q[first] - q[second]) ** 2, 1), q[0], q[width - 1]
    constraints = {
        "left": lj.Holonomic(lambda t, q, params: q[0] - left),
        "links": lj.Holonomic(lambda t, q, params: jnp.sum((q[first] - q[second]) ** 2, axis=1) - squares),
        "right": lj.Holonomic(lambda t, q, params: q[width - 1] - right),
    }
    return lj.System(particles, constraints), q, np.zeros_like(q), parameters(width**2)


def chain_in_angles(count):
    """The open chain in absolute angles: no constraints, and a mass matrix that couples all angles."""

    def lagrangian(t, q, v, params):
        x = params["l"] * jnp.cumsum(jnp.cos(q) * v)
        y = params["l"] * jnp.cumsum(jnp.sin(q) * v)
        height = -params["l"] * jnp.cumsum(jnp.cos(q))
        return params["m"] * jnp.sum(0.5 * (x**2 + y**2) - params["g"] * height)

    angle = hanging_angles(count)
    return lj.System(lagrangian), angle, np.zeros(count), parameters(count)


SCENES = {
    "open chain": open_chain,
    "chain hung at both ends": hung_chain,
    "closed chain": closed_chain,
    "net": net,
    "chain in angles": chain_in_angles,
}


def evaluations(system, q, v, params):
    """A compiled loop of evaluations, each at a state that depends on the previous one."""

    def loop(t, q, v, params):
        equations = equations_of(model_of(system, t, q, v, params))
        independent = equations.independent(t, q, v)

        def once(state, _):
            q, v = state
            a, _ = equations.accelerations(t, q, v, None, independent)
            return (q + 1e-12 * v, v + 1e-12 * a), None

        return jax.lax.scan(once, (q, v), length=EVALUATIONS)[0]

    arguments = state(0.0, q, v, params)
    program, _ = compiled(loop, *arguments)
    return lambda: program(*arguments)


def steps(system, q, v, params):
    """A compiled integration with fixed steps, each a hundredth of the time in which a link falls by its length."""
    step = 0.01 * jnp.sqrt(params["l"] / params["g"])

    def solve(q, v, params, step):
        return lj.integrate(
            system, q, v, params, ts=jnp.array([0.0, STEPS]) * step, dt0=step,
            stepsize_controller=diffrax.ConstantStepSize(), throw=False,
        )  # fmt: skip

    arguments = (jnp.asarray(q), jnp.asarray(v), params, step)
    program, seconds = compiled(solve, *arguments)
    return (lambda: program(*arguments)), seconds


def growth(counts, seconds):
    """The exponent p of cost = N^p, by least squares of the logarithms."""
    return float(np.polyfit(np.log(counts), np.log(seconds), 1)[0])


def rows(wanted):
    """The rows of all scenes, then the comparison with angles."""
    for name, scene in SCENES.items():
        if wanted(name):
            yield from of_scene(name, scene)
    if wanted("cartesian / angles"):
        yield from against_angles()


def of_scene(name, scene):
    """Cost of an evaluation and of a step, compile time, error; and the exponents."""
    found = {}
    counts = [count for count in COUNTS if count >= (3 if scene is closed_chain else 4 if scene is net else 2)]
    for count in counts:
        case = scene(count)
        evaluate, (solve, seconds) = evaluations(*case), steps(*case)
        times = in_turn(evaluate, solve, repeats=REPEATS, shortest=2e-3)
        (of_evaluation, of_solve), (least_evaluation, least_solve) = times.medians, times.minima
        motion = solve()
        assert bool(motion.result == lj.RESULTS.successful), motion.result
        per = 1e6 / EVALUATIONS, 1e6 / STEPS
        found[count] = least_evaluation * per[0], least_solve * per[1], seconds
        yield row(f"{name}, N = {count}: evaluation, us", of_evaluation * per[0], least=least_evaluation * per[0])
        yield row(
            f"{name}, N = {count}: step, us", of_solve * per[1], least=least_solve * per[1],
            energy=float(motion.drift()), residual=float(motion.residual()) if case[0].constraints else 0.0,
        )  # fmt: skip
        yield row(f"{name}, N = {count}: trace and compile, s", seconds)
    fitted = [count for count in counts if FITTED[0] <= count <= FITTED[1]]
    exponents = [growth(fitted, [found[count][i] for count in fitted]) for i in range(3)]
    # The net's band grows with its width, and the angles' mass matrix is dense.
    target = None if scene in (net, chain_in_angles) else 1.3
    yield row(f"{name}: exponent of an evaluation, N = 16 to 256", exponents[0], target)
    yield row(f"{name}: exponent of a step, N = 16 to 256", exponents[1], target)
    yield row(f"{name}: exponent of compiling, N = 16 to 256", exponents[2], None if target is None else 0.1)


def against_angles():
    """The same motion, 0.5 s at 1e-9, in Cartesian coordinates and in angles: time, and difference at the end."""
    for count in (2, 4, 8, 16):
        solves = []
        for scene in (open_chain, chain_in_angles):
            system, q, v, params = scene(count)
            solve = lambda tolerance, system=system, q=q, v=v, params=params: lj.integrate(
                system, q, v, params, ts=jnp.array([0.0, 0.5]), rtol=tolerance, atol=tolerance, throw=False
            )
            solves.append(jax.jit(solve))
        cartesian, angles = (lambda solve=solve: solve(jnp.asarray(1e-9)) for solve in solves)
        times = in_turn(cartesian, angles, repeats=REPEATS)
        ends, angle = cartesian().q[-1], angles().q[-1]
        expected = np.cumsum(np.stack([np.sin(angle), -np.cos(angle)], 1), axis=0) / count
        median, least = times.ratio()
        yield row(
            f"cartesian / angles, N = {count}, 0.5 s at 1e-9", median, least=least,
            apart=float(np.max(np.abs(ends - expected))), energy=float(cartesian().drift()),
            energy_in_angles=float(angles().drift()),
        )  # fmt: skip


if __name__ == "__main__":
    main(rows, __doc__)
