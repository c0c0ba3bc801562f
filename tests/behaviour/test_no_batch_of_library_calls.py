"""No program of lagjax's calls LAPACK for several matrices at once on a CPU, which can stop a process for good."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.counting import COMPILED_FASTER
from tests.library_calls import batches_in, calls_in, text_of
from tests.tiers import exhaustive_but

COUNT, LANES = 18, 3
# Seconds for a process, below those after which pytest ends a test (`faulthandler_timeout`).
LIMIT = 840


def coupled(t, q, v, p):
    """A chain whose inverse masses are coupled, of so many numbers that the equations are solved by LAPACK."""
    spread = 1 + 0.1 * jnp.cos(q)
    mass = jnp.diag(spread) + 0.05 * jnp.outer(spread, spread)
    return 0.5 * v @ mass @ v - 0.5 * p["k"] * q @ q


def with_library(t, q, v, p):
    """A Lagrangian whose author calls LAPACK: V = ½ qᵀ S⁻¹ q + ln det S + the lowest root of S, S = 1 + k q qᵀ / 9."""
    s = jnp.eye(3) + p["k"] * jnp.outer(q, q) / 9
    return 0.5 * v @ v - 0.5 * q @ jnp.linalg.solve(s, q) - jnp.linalg.slogdet(s)[1] - jnp.linalg.eigvalsh(s)[0]


LARGE, OWN = lj.System(coupled), lj.System(with_library)
RING = lj.System(
    lambda t, q, v, p: 0.5 * v @ v - p["k"] * jnp.sum(q[1::2]),
    {"rods": lj.Holonomic(lambda t, q, p: jnp.sum(jnp.diff(q.reshape(-1, 2), axis=0) ** 2, axis=1) - 1.0)},
)
AT = {
    "large": (LARGE, np.linspace(0.1, 0.4, COUNT), np.zeros(COUNT)),
    "own": (OWN, np.array([0.3, 0.2, -0.1]), np.zeros(3)),
    "ring": (RING, np.stack([np.arange(10.0), np.zeros(10)], 1).ravel(), np.zeros(20)),
}
STIFFNESS = np.linspace(1.0, 2.0, LANES)


def end(name, **options):
    """The end of a motion as a function of k."""
    system, q, v = AT[name]
    return lambda k: lj.integrate(system, q, v, {"k": k}, ts=jnp.array([0.0, 0.1]), throw=False, **options).q[-1]


def accelerations(name):
    """The accelerations as a function of k."""
    system, q, v = AT[name]
    return lambda k: lj.accelerations(system, 0.0, q, v, {"k": k})[0]


def modes(k):
    """The frequencies of the system whose author calls LAPACK."""
    return lj.normal_modes(OWN, 0.0, jnp.zeros(3), jnp.zeros(3), {"k": k}).roots.imag


lanes = jax.vmap
PROGRAMS = {
    "accelerations, large": lanes(accelerations("large")),
    "accelerations, constraints": lanes(accelerations("ring")),
    "in reverse": lanes(jax.grad(lambda k: jnp.sum(accelerations("own")(k)))),
    "modes": lanes(modes),
}
SLOW = {
    "accelerations, own": lanes(accelerations("own")),
    "their derivatives": lanes(jax.jacfwd(accelerations("own"))),
    "second derivatives": lanes(jax.jacfwd(jax.grad(lambda k: jnp.sum(accelerations("own")(k))))),
    "modes, derivatives": lanes(jax.jacfwd(modes)),
    "motion, large": lanes(end("large")),
    "motion, own": lanes(end("own")),
    "motion, forward": lanes(jax.jacfwd(end("own"))),
    "motion, constraints": lanes(end("ring")),
    "motion, reverse": lanes(jax.grad(lambda k: jnp.sum(end("own")(k)))),
    "motion, second": lanes(jax.jacfwd(jax.grad(lambda k: jnp.sum(end("own")(k))))),
    "motion, replayed": lanes(jax.grad(lambda k: jnp.sum(end("large", adjoint=lj.Replay())(k)))),
    "motion, stiff": lanes(end("large", method=lj.Radau5())),
}


KEPT = "second derivatives", "modes, derivatives", "motion, large", "motion, reverse"


@pytest.mark.parametrize("name", PROGRAMS)
def test_no_batches(name):
    """Inside the user's own `jit` and `vmap`: there are calls of LAPACK, each for one matrix."""
    text = text_of(PROGRAMS[name], STIFFNESS)
    assert calls_in(text) != [] and batches_in(text) == []


@pytest.mark.slow
@pytest.mark.parametrize("name", exhaustive_but(KEPT, SLOW))
def test_no_batches_in_motions(name):
    """The same for motions that take longer to lower."""
    text = text_of(SLOW[name], STIFFNESS)
    assert calls_in(text) != [] and batches_in(text) == []


def test_a_batch_is_found():
    """Twin: the same Lagrangian in a program of the user's alone has batches."""
    system, q, v = AT["own"]
    assert batches_in(text_of(jax.vmap(lambda k: with_library(0.0, q, v, {"k": k})), STIFFNESS)) != []


EAGER = """
import jax
jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp, numpy as np, lagjax as lj
from tests.behaviour.test_no_batch_of_library_calls import AT, end, OWN, RING
ts, system, q, v = jnp.linspace(0.0, 0.2, 5), *AT["own"]
lj.energy_ledger(lj.integrate(RING, AT["ring"][1], AT["ring"][2], {"k": 1.0}, ts=ts))
motion = lj.integrate(OWN, q, v, {"k": 1.5}, ts=ts)
lj.energy_ledger(motion)
lj.sweep(lambda point: end("own")(point["k"]), {"k": np.linspace(1.0, 2.0, 4)})
lj.equilibria(OWN, {"k": 1.0}, starts=[jnp.array([0.1, 0.0, 0.0]), jnp.array([0.0, 0.2, 0.1])])
"""
# Not by `preexec_fn`, which forks: JAX warns of that.
TWO_CORES = """
import os
if hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
"""


def programs_of(script, folder, **environment):
    """The text of every program that a script compiles in a process with two cores and a time limit."""
    root = Path(__file__).parents[2]
    # The texts are those that XLA is given; what it makes of them is not looked at.
    faster = " ".join(f"--{name}={str(value).lower()}" for name, value in COMPILED_FASTER)
    quick = {"OPENBLAS_NUM_THREADS": "1", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "XLA_FLAGS": faster}
    environment = {**os.environ, "JAX_DUMP_IR_TO": str(folder), **quick, **environment}
    subprocess.run([sys.executable, "-c", TWO_CORES + script], cwd=root, env=environment, check=True, timeout=LIMIT)
    return [path.read_text() for path in folder.glob("*.mlir")]


@pytest.mark.slow
@pytest.mark.parametrize("plain", exhaustive_but(("",), ("", "1")))
def test_no_batches_from_python(plain, tmp_path):
    """Ledgers, sweeps, analysis called from Python: no program of the process has a batch, with `LAGJAX_PLAIN` too."""
    texts = programs_of(EAGER, tmp_path, LAGJAX_PLAIN=plain)
    assert sum(len(calls_in(text)) for text in texts) > 0
    assert [batches_in(text) for text in texts if batches_in(text)] == []
