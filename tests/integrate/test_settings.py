"""Settings of a motion: a pytree whose numbers are arrays; and the patience with its steps."""

import jax
import numpy as np
import pytest

from lagjax.integrate.settings import PATIENCE, Settings, patient

BASIC = Settings(
    method=None, controller=None, event=None, adjoint=None, rtol=np.full(2, 1e-9), atol=np.full(2, 1e-12), dt0=None,
    max_step=np.asarray(np.inf), jump_ts=None, shares=np.ones(2), repeated_up_to=np.asarray(20_000), by_size=True,
    apart=False, max_steps=4096, drift="project", progress=None,
)  # fmt: skip


def test_only_numbers_are_leaves():
    """Tolerances may be traced, and share a program; what decides about the program is part of its structure."""
    leaves, structure = jax.tree.flatten(BASIC)
    assert len(leaves) == 5
    looser = jax.tree.map(lambda x: 2 * x, BASIC)
    assert jax.tree.structure(looser) == structure and float(looser.rtol[0]) == 2e-9 and looser.drift == "project"
    fewer = Settings(**(vars(BASIC) | {"max_steps": 8}))
    assert jax.tree.structure(fewer) != structure


@pytest.mark.parametrize(
    ("limit", "patience", "steps"), [(None, None, None), (100, None, 100), (None, 30, 30), (100, 30, 30), (10, 30, 10)]
)
def test_the_patience_of_a_batch_counts(limit, patience, steps):
    """The smaller limit holds inside of the context, and none outside of it but the motion's own."""
    with PATIENCE(patience):
        assert patient(limit) == steps
    assert patient(limit) == limit
