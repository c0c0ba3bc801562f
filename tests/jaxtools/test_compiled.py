"""Options of XLA: they are left out if it does not know them, and have an effect if it does."""

from importlib import import_module

import jax
import jax.numpy as jnp
import pytest

from lagjax.jaxtools.cache import FACTS, WITHOUT_EMITTERS, compiler_options

# The room hands out a function of this name.
compiled = import_module("lagjax.jaxtools.cache")


def test_unknown_options_are_left_out(monkeypatch):
    """An option that XLA does not know is not used; twin: a known one is, but not in plain mode."""
    FACTS.clear()
    known = compiler_options()
    assert known in (None, WITHOUT_EMITTERS) and jax.jit(jnp.sin, compiler_options=known)(0.0) == 0.0
    FACTS.clear()
    monkeypatch.setattr(compiled, "WITHOUT_EMITTERS", {"xla_cpu_no_such_option": False})
    assert compiler_options() is None
    FACTS.clear()
    monkeypatch.setattr(compiled, "is_plain", lambda: True)
    monkeypatch.setattr(compiled, "WITHOUT_EMITTERS", WITHOUT_EMITTERS)
    assert compiler_options() is None
    FACTS.clear()


@pytest.mark.optimised
@pytest.mark.skipif(compiler_options() is None, reason="this XLA has no such option")
def test_another_way_to_write_kernels(tmp_path):
    """The option reaches XLA: it writes different machine code for the same program."""

    def code(options, folder):
        shown = {"xla_dump_to": str(folder), "xla_dump_hlo_as_text": True}
        jax.jit(lambda x: jnp.sum(jnp.sin(x) * x)).lower(jnp.ones(1000)).compile(
            compiler_options=(options or {}) | shown
        )
        return "".join(sorted(p.read_text() for p in folder.glob("*.ll")))

    with_emitters, without = code({}, tmp_path / "with"), code(WITHOUT_EMITTERS, tmp_path / "without")
    assert with_emitters and without and with_emitters != without
    assert code({}, tmp_path / "again") == with_emitters
