"""The programs of earlier sweeps, for another sweep that computes the same over axes of the same kinds.

What a sweep computes is the jaxpr of its function, which is traced for each sweep; so no stale program is ever used.
"""

import time
from collections.abc import Callable, Sequence

import jax

from lagjax.display.progress import waiting
from lagjax.jaxtools.cache import program_of
from lagjax.jaxtools.jaxpr_identity import Meaning, content_of, meaning_of
from lagjax.sweep.axes import Axes
from lagjax.sweep.batch_program import Program, compiled, traced_point


def program_for(
    run: Callable,
    axes: Axes,
    chunk: int,
    devices: Sequence,
    layout: str,
    patience: int | None = None,
    robust: bool = True,
    progress: bool | None = False,
) -> tuple[Program, float]:
    """The program, and the seconds it took to compile; 0 if it was in the cache."""
    seconds = 0.0

    def make():
        nonlocal seconds
        started = time.perf_counter()
        with waiting(progress, "compiling"):
            program = compiled(run, axes, chunk, devices, layout, patience, robust)
        seconds = time.perf_counter() - started
        return program

    program, structure = traced_point(run, axes, patience, robust)
    meaning = Meaning((meaning_of(program.jaxpr), structure, tuple(map(content_of, program.consts))))
    settings = (tuple(jax.config.values.items()), jax.sharding.get_abstract_mesh())
    key = meaning, axes.names, chunk, tuple(devices), layout, patience, robust, settings
    return program_of(key, make), seconds
