"""The marks have an effect: count XLA's kernels of a small program with them, and without each of them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from lagjax.jaxtools import fuse_cpu as one_function_module
from lagjax.jaxtools.fuse_cpu import kept_as_call, one_function
from lagjax.jaxtools.plain import is_plain
from lagjax.jaxtools.xla_marks import ONE_KERNEL, marked

pytestmark = [
    pytest.mark.optimised,
    pytest.mark.skipif(is_plain(), reason="LAGJAX_PLAIN: nothing is marked"),
    pytest.mark.skipif(jax.default_backend() != "cpu", reason="the marks are for CPUs"),
]


def branches(x):
    """Branches in a row, none of them in a loop, since XLA may choose a loop by itself."""
    for i in range(20):
        x = jnp.sin(x) + lax.cond(x > i, lambda x: x, lambda x: 2 * x, x)
    return x


def kernels(function, folder):
    """How many pieces of machine code XLA makes of a function of one number, and the compiled program."""
    lowered = jax.jit(function).lower(jnp.asarray(2.0))
    compiled = lowered.compile(compiler_options={"xla_dump_to": str(folder)})
    return len(list(folder.glob("*.obj-file.*"))), compiled


def test_one_kernel(tmp_path):
    """A program compiled as one function is one kernel, with the same result; plainly compiled it is many."""
    one, compiled = kernels(lambda x: one_function(branches, x), tmp_path / "one")
    many, plain = kernels(branches, tmp_path / "many")
    assert one == 1 and many > 10
    np.testing.assert_allclose(compiled(jnp.asarray(2.0)), plain(jnp.asarray(2.0)), rtol=1e-14)


@pytest.mark.parametrize("mark", ONE_KERNEL)
def test_each_mark_is_needed(monkeypatch, tmp_path, mark):
    """Twin: with either mark misspelt the same program is many kernels."""
    misspelt = {f"{name}_" if name == mark else name: value for name, value in ONE_KERNEL.items()}
    monkeypatch.setattr(one_function_module, "ONE_KERNEL", misspelt)
    assert kernels(lambda x: one_function(branches, x), tmp_path)[0] > 10


def test_a_call_stays_one():
    """A marked call stays a call in the compiled program; twin: without the mark it is inlined."""

    def twice(mark):
        part = jax.jit(lambda x: (branches(x), x))
        return lambda x: branches(mark(part(x))[0]) + mark(part(x + 1))[0]

    calls = lambda mark: jax.jit(twice(mark)).lower(jnp.asarray(2.0)).compile().as_text().count(" call(")
    assert calls(kept_as_call) == 2 and calls(lambda results: results) == 0


def test_marks_reach_the_program():
    """The attributes stand on the call in the program that XLA is given."""
    text = jax.jit(lambda x: marked(jax.jit(jnp.sin)(x), ONE_KERNEL)).lower(1.0).as_text()
    assert all(f'{name} = "{value}"' in text for name, value in ONE_KERNEL.items())
