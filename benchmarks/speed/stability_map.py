"""How long does a stability map of 100,000 systems take, and is each verdict right?

The carriage on rotating cross-rails, m ω²/K and m ω²/k each from 0.05 to 20: its small motions stay small exactly where
(1 - m ω²/K)(1 - m ω²/k) > 0. `lj.normal_modes` at its equilibrium judges each pair of springs, as `lj.sweep` calls it;
the second call is timed, after compiling.

    wrong verdicts      among the points where |1 - m ω²/K| and |1 - m ω²/k| exceed 1e-12: on a critical line itself a
                        frequency is zero, and round-off in the inputs decides
    seconds             wall time of a whole call, labelled results included

    python -m benchmarks.speed.stability_map [--json FILE]
"""

import time

import jax
import numpy as np

import lagjax as lj
from benchmarks.measure import main, row
from lagjax.scenes.cross_rails import is_held

jax.config.update("jax_enable_x64", True)

SIDES, CALLS, DECIDED = (316, 317), 5, 1e-12


def rows(wanted):
    """The rows of the map, on a grid that crosses both critical lines."""
    over_K, over_k = (np.geomspace(0.05, 20.0, count) for count in SIDES)
    call = lambda: lj.sweep(
        lambda point: is_held(point["over_K"], point["over_k"]), {"over_K": over_K, "over_k": over_k}, progress=False
    )
    call()
    times = []
    for _ in range(CALLS):
        began = time.perf_counter()
        swept = call()
        times.append(time.perf_counter() - began)
    margins = np.meshgrid(1 - over_K, 1 - over_k, indexing="ij")
    decided = np.min(np.abs(margins), axis=0) > DECIDED
    wrong = np.sum((np.asarray(swept.values) != (margins[0] * margins[1] > 0)) & decided)
    size = {"points": decided.size, "left out": int(np.sum(~decided))}
    yield row("stability map: wrong verdicts", int(wrong), 0, **size)
    yield row("stability map: seconds, median", np.median(times), 2, least=min(times), calls=CALLS)


if __name__ == "__main__":
    main(rows, __doc__)
