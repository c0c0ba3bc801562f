"""Sizes at which XLA behaves differently: many outputs, wide networks, long tables; in processes that may crash.

The oscillator q'' = -q from rest at 1 is cos t.
"""

import os
import subprocess
import sys

import pytest

from tests.tiers import exhaustive_but

START = """
import jax, jax.numpy as jnp, numpy as np, equinox as eqx, lagjax as lj
jax.config.update("jax_enable_x64", True)
oscillator = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * p * q**2)
motion = lambda q0, ts, **kw: lj.integrate(oscillator, q0, 0.0, 1.0, ts=ts, **kw).q
def agrees(found, expected, tolerance=1e-7):
    np.testing.assert_allclose(found, expected, atol=tolerance)
"""
TRANSFORMED = {
    "closed over": "agrees(jax.jit(lambda q: motion(q, ts))(1.0), np.cos(ts))",
    "closed over, as an array of JAX": "agrees(jax.jit(lambda q: motion(q, known))(1.0), np.cos(ts))",
    "passed": "agrees(jax.jit(motion)(1.0, ts), np.cos(ts))",
    "made inside": "agrees(jax.jit(lambda q: motion(q, jnp.linspace(0.0, 3.0, size)))(1.0), np.cos(ts))",
    "eager": "agrees(motion(1.0, ts), np.cos(ts))",
    "forward": "agrees(jax.jit(jax.jacfwd(lambda q: motion(q, ts)))(1.0), np.cos(ts))",
    "reverse": "agrees(jax.jit(jax.grad(lambda q: motion(q, ts)[-1]))(1.0), np.cos(ts[-1]))",
    "lanes": "agrees(jax.jit(jax.vmap(lambda q: motion(q, ts)))(jnp.array([1.0, 2.0]))[1], 2 * np.cos(ts))",
    "Dopri8": "agrees(jax.jit(lambda q: motion(q, ts, method=lj.Dopri8()))(1.0), np.cos(ts))",
}


def survives(script):
    """Run the script; it must succeed, otherwise show its last output."""
    run = [sys.executable, "-c", START + script]
    ended = subprocess.run(run, capture_output=True, text=True, timeout=900, env=os.environ | {"PYTHONPATH": "."})
    assert ended.returncode == 0, f"{ended.stdout[-300:]}\n{ended.stderr[-2000:]}"


@pytest.mark.exhaustive
@pytest.mark.parametrize("how", exhaustive_but(("closed over",), TRANSFORMED))
def test_any_number_of_outputs(how):
    """From 2 times (one output after the start) to 100,000; XLA ended the process for constants above 10 kB."""
    sizes = (2, 3, 1000, 1024, 1025, 1251, 5000, 100_000) if how == "closed over" else (2, 1251, 100_000)
    lines = [f"for size in {sizes}:", "    print(size, flush=True)"]
    lines += ["    ts = np.linspace(0.0, 3.0, size)", "    known = jnp.asarray(ts)", "    " + TRANSFORMED[how]]
    survives("\n".join(lines))


@pytest.mark.exhaustive
def test_mass_matrices_and_tables_of_any_size():
    """Around 16 coordinates, whose matrix products have 4,096 multiplications, and tables around 10 kB."""
    survives("""
for n in (9, 15, 16, 17):
    k = np.random.default_rng(0).normal(size=(n, n))
    mass = n * np.eye(n) + k @ k.T
    system = lj.System(lambda t, q, v, p: 0.5 * v @ (p @ v) - 0.5 * q @ (p @ q))
    found = lj.integrate(system, jnp.ones(n), jnp.zeros(n), jnp.asarray(mass), ts=np.array([0.0, 0.9])).q
    agrees(found[-1], np.cos(0.9))
for size in (1000, 1251, 2001):
    grid = jnp.linspace(0.0, 10.0, size)
    system = lj.System(lambda t, q, v, p: 0.5 * v**2, force=lambda t, q, v, p: (grid - t)[jnp.round(t).astype(int)] + t)
    agrees(lj.integrate(system, 1.0, 0.0, ts=np.array([0.0, 0.4])).q[-1], 1.0)
""")
