"""Bodies and trees in lanes on a GPU, beside the same lanes on the CPU of that machine.

links     accelerations of a chain of 64 hinged rods (`lj.bodies.Tree`), each lane in a state of its own
tops      heavy tops (`lj.bodies.multibody`, a quaternion and its constraint) of different spins for one second
arms      three hinged rods for one second, each lane released from angles of its own
host      operations of these programs that need the host (`host_operations.py`)

python -m benchmarks.gpu.bodies [--small] [--json FILE] [--only TEXT]
"""

import os

os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import lagjax as lj  # noqa: E402
from benchmarks.gpu.host_operations import host_operations  # noqa: E402
from benchmarks.measure import compiled, in_turn, main, row, small  # noqa: E402
from benchmarks.speed.trees import chain, relative_angles  # noqa: E402

jax.config.update("jax_enable_x64", True)

OPTIONS = {"small": False}
# Lanes of accelerations, and of motions.
LANES, SMALL = (4_096, 1_024), (64, 16)
TIMES = np.array([0.0, 1.0])
RTOL, AGREE, MOTIONS_AGREE = 1e-8, 1e-10, 1e-5


def links(lanes):
    """Accelerations of 64 links: the function of a lane, and its arguments."""
    system, _ = chain(64)
    turned = relative_angles(64) * (1 + 1e-3 * np.arange(lanes)[:, None])

    def at(angles):
        state = {"angles": angles}
        a, _ = lj.accelerations(system, 0.0, state, {"angles": 0.5 * jnp.cos(angles)}, None)
        return a["angles"]

    return at, turned


def tops(lanes):
    """Heavy tops on a spherical joint, by their spin."""
    top = lj.bodies.Body("top", mass=1.0, inertia=(0.1, 0.1, 0.05))
    tip = lj.bodies.spherical(lj.bodies.ground.at((0.0, 0.0, 0.0)), top.at((0.0, 0.0, -0.5)))
    weight = lambda t, q, v, p: -p["g"] * top.point(q, (0.0, 0.0, 0.0))[2]
    system = lj.bodies.multibody([top], {"tip": tip}, lagrangian=weight)
    lying = lj.bodies.Pose.at((0.5, 0.0, 0.0), axis=(0.0, 1.0, 0.0), angle=jnp.pi / 2)

    def end(spin):
        around = spin * jnp.array([1.0, 0.0, 0.0])
        moving = lying.moving(velocity=jnp.cross(around, lying.position), spin=around)
        motion = lj.integrate(system, {"top": lying}, {"top": moving}, {"g": 9.81}, ts=TIMES, rtol=RTOL, throw=False)
        return motion.q["top"].position[-1]

    return end, np.linspace(40.0, 80.0, lanes)


def arms(lanes):
    """Three hinged rods, by their first angle."""
    system, _ = chain(3)

    def end(angle):
        q = {"angles": angle * jnp.array([1.0, 0.3, -0.2])}
        motion = lj.integrate(system, q, jax.tree.map(jnp.zeros_like, q), None, ts=TIMES, rtol=RTOL, throw=False)
        return motion.q["angles"][-1]

    return end, np.linspace(0.3, 1.2, lanes)


def rows(wanted):
    """For each kind: its time on the device beside the CPU's, the difference, and operations of the host."""
    of_states, of_motions = SMALL if OPTIONS["small"] else LANES
    device, cpu = jax.devices()[0], jax.devices("cpu")[0]
    for make, lanes, agree in ((links, of_states, AGREE), (tops, of_motions, MOTIONS_AGREE), (arms, of_motions, MOTIONS_AGREE)):
        title = f"{lanes:,} {make.__name__}"
        if not wanted(title):
            continue
        function, values = make(lanes)
        programs, first, found = [], [], []
        for where in (device, cpu):
            with jax.default_device(where):
                given = jax.device_put(values, where)
                program, seconds = compiled(jax.vmap(function), given)
                programs.append(lambda program=program, given=given: program(given))
                first.append((program, seconds))
                found.append(np.asarray(program(given)))
        times = in_turn(*programs, repeats=3)
        yield row(f"{title}: device / CPU", times.ratio(0, 1)[0], None, ms=1e3 * times.medians[0],
                  cpu_ms=1e3 * times.medians[1], us_a_lane=1e6 * times.medians[0] / lanes, compile_s=first[0][1],
                  cpu_compile_s=first[1][1], device=device.device_kind)  # fmt: skip
        yield row(f"{title}: differ by", np.max(np.abs(found[0] - found[1])) / np.max(np.abs(found[1])), agree)
        yield row(f"{title}: operations on the host", len(host_operations(first[0][0].as_text())), 0)


if __name__ == "__main__":
    OPTIONS["small"] = small()
    main(rows, __doc__)
