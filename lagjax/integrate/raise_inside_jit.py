"""Failures raised at run time, including those of an empty batch.

Equinox raises the largest code of the lanes that fail, and an empty batch has no largest code.
"""

import equinox as eqx
import jax.numpy as jnp

from lagjax.integrate.trajectory.results import RESULTS, ended_well
from lagjax.integrate.trajectory.trajectory import Trajectory
from lagjax.jaxtools.primitives import primitive


def raise_at_run_time(trajectory: Trajectory) -> Trajectory:
    """Return the trajectory; if it failed, the program that computes it ends with the message of its result."""
    code = _code_p.bind(jnp.asarray(trajectory.result._value))
    result = eqx.tree_at(lambda result: result._value, trajectory.result, code)
    return result.error_if(trajectory, ~ended_well(result))


def _batched(operands, axes):
    (code,), (axis,) = operands, axes
    if code.shape[axis] == 0:
        return jnp.full(code.shape[:axis] + code.shape[axis + 1 :], RESULTS.successful._value), None
    return _code_p.bind(code), axis


_same = lambda code: code
_code_p = primitive("result_code", _same, _same, batched=_batched)
