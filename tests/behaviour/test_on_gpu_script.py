"""Assumptions of `benchmarks/gpu/on_gpu.py`: a batch and its gradient never need the host, and the check detects it."""

import json
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.experimental import io_callback

import lagjax as lj
from benchmarks.gpu.host_operations import host_operations, with_a_look

TS, WEIGHTS = np.array([0.0, 1.0]), np.random.default_rng(0).normal(size=(3, 10))


def learned(looked_at=False):
    """A particle in a potential of 30 numbers, more than use forward mode; optionally with a callback in L."""

    def lagrangian(t, q, v, weights):
        if looked_at:
            jax.debug.callback(lambda x: None, q)
        return 0.5 * v**2 - 0.5 * q**2 - jnp.dot(weights[2], jnp.tanh(weights[0] * q + weights[1]))

    return lj.System(lagrangian)


def text_of_gradient(system):
    """The compiled program of the gradient by 30 numbers of 4 motions, which replays steps backward."""

    def end(weights, q0):
        return lj.integrate(system, q0, 0.0, weights, ts=TS, rtol=1e-6, method=lj.Tsit5(), throw=False).q[-1]

    loss = lambda weights, q0: jnp.sum(jax.vmap(end, (None, 0))(weights, q0) ** 2)
    return jax.jit(jax.grad(loss)).lower(WEIGHTS, np.linspace(0.0, 1.0, 4)).compile().as_text()


@pytest.mark.exhaustive
def test_a_gradient_that_replays_steps_stays_on_the_device():
    """The compiled gradient has no operation on the host."""
    assert host_operations(text_of_gradient(learned())) == []


def calls_for_cuda(function, *args):
    """What a program that is lowered for CUDA calls outside of XLA, such as libraries of linear algebra."""
    lowered = jax.jit(function).trace(*args).lower(lowering_platforms=("cuda",))
    return set(re.findall(r"custom_call @(\w+)", lowered.as_text()))


@pytest.mark.slow
def test_steps_for_cuda_call_nothing():
    """Lanes of fixed steps with controls, and their gradient, call nothing on a GPU; twin: an inverse does."""
    cart = lj.System(lambda t, q, v, params: 0.5 * v**2 - 0.5 * params["k"] * q**2 + params["push"] * q)

    def end(k, q0):
        return lj.rollout(cart, q0, 0.0, {"k": k}, {"push": jnp.ones(5)}, 0.1)[1][-1]

    lanes = jax.vmap(end, (None, 0))
    loss = lambda k, q0: jnp.sum(lanes(k, q0) ** 2)
    arguments = jnp.asarray(2.0), jnp.linspace(0.0, 1.0, 4)
    assert calls_for_cuda(lanes, *arguments) == calls_for_cuda(jax.grad(loss), *arguments) == set()
    assert calls_for_cuda(lambda k, q0: jnp.linalg.inv(jnp.eye(3) * k), *arguments)


@pytest.mark.exhaustive
def test_products_keep_their_digits():
    """On a GPU each product of matrices of a rod's motion asks for all digits of float32; twin: as the user sets it."""
    rod = lj.Holonomic(lambda t, q, params: jnp.sum(q**2) - 1.0)
    mass = np.array([[2.0, 0.5], [0.5, 1.0]], np.float32)
    swinging = lj.System(lambda t, q, v, params: 0.5 * v @ (mass @ v) - params["g"] * q[1], {"rod": rod})

    def precisions():
        end = lambda g, x: lj.integrate(swinging, x, 0 * x, {"g": g}, ts=np.array([0, 1], np.float32), rtol=1e-5,
                                          throw=False).q[-1]  # fmt: skip
        lanes = jax.jit(jax.vmap(end, (None, 0))).trace(np.float32(9.81), np.eye(2, dtype=np.float32))
        text = lanes.lower(lowering_platforms=("cuda",)).as_text()
        return set(re.findall(r"dot_general .*precision = \[(\w+)", text))

    assert precisions() == {"HIGHEST"}
    with jax.default_matmul_precision("tensorfloat32"):
        assert "HIGH" in precisions()


def test_operations_on_the_host_are_found():
    """Callbacks of any kind in a compiled program, and transfers as XLA names them, are found."""
    shape = jax.ShapeDtypeStruct((), jnp.float64)
    for function in (
        with_a_look(jnp.sin),
        lambda x: jax.pure_callback(np.sin, shape, x),
        lambda x: io_callback(np.sin, shape, x),
    ):
        assert len(host_operations(jax.jit(function).lower(1.0).compile().as_text())) == 1
    assert host_operations(jax.jit(jnp.sin).lower(1.0).compile().as_text()) == []
    transfers = (
        "  %infeed.1 = ((f32[3]{0}, pred[]), token[]) infeed(%token.0)\n"
        "  %outfeed.1 = token[] outfeed(%p.0, %token.0), outfeed_shape=(f32[2]{0})\n"
        "  %send.1 = (f32[], u32[], token[]) send(%p.0, %token.0), channel_id=1, is_host_transfer=true\n"
    )
    assert host_operations(transfers) == ["infeed", "outfeed", "send"]


def test_names_are_no_operations():
    """A callback named in the metadata of other operations does not count, nor a fusion named outfeed."""
    named = (
        '  %sine.1 = f64[] sine(%x.1), metadata={op_name="jit(callback)/sin"}\n'
        '  %solve.1 = f64[2,2] custom-call(%x.1), custom_call_target="lapack_dgetrf_ffi"\n'
        "  %outfeed_fusion = f64[] fusion(%infeed.2), kind=kLoop\n"
    )
    assert host_operations(named) == []


@pytest.mark.exhaustive
def test_a_callback_in_the_lagrangian_is_found():
    """Twin: a callback is found in the program of the gradient as well."""
    assert host_operations(text_of_gradient(learned(looked_at=True)))


@pytest.mark.exhaustive
def test_the_script_runs_small(tmp_path):
    """On any machine: motions of rods, and float32 results. A shared machine may only miss the speed target."""
    file = tmp_path / "rows.json"
    run = [sys.executable, "-m", "benchmarks.gpu.on_gpu", "--small", "--processor-time", "--json", str(file), "--only"]
    for what in ("rods, float64, motions", "single precision, rods"):
        subprocess.run([*run, what], check=True, capture_output=True, text=True, timeout=900)
        rows = json.loads(file.read_text())["rows"]
        assert len(rows) >= 3
        for row in rows:
            assert row["met"] is not False or "ours / diffrax" in row["what"], row
