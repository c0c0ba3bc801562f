"""Digests of data and of programs, the same in every process."""

import hashlib
import re

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

from lagjax.jax_internals.programs import ClosedJaxpr, bodies


def digest(data: bytes) -> str:
    """The first 64 bits of a SHA-256 hash, as text."""
    return hashlib.sha256(data).hexdigest()[:16]


def program_digest(closed: ClosedJaxpr) -> str:
    """A digest of what a program computes."""
    return digest(_text(closed).encode())


def _text(closed):
    # Memory addresses are removed; the constants of nested programs are added.
    constants = "".join(digest(_data(x)) for x in closed.consts if not isinstance(x, Tracer))
    return re.sub(r"0x[0-9a-f]+", "", str(closed.jaxpr)) + constants + "".join(_constants(closed.jaxpr))


def _constants(jaxpr):
    for equation in jaxpr.eqns:
        for value in equation.params.values():
            for part in value if isinstance(value, (tuple, list)) else (value,):
                if isinstance(part, ClosedJaxpr):
                    yield from (digest(_data(x)) for x in part.consts)
        for body in bodies(equation):
            yield from _constants(body)


def _data(x):
    is_key = jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(x) if is_key else x).tobytes()
