"""The derivative of the woodpecker's period by friction and stiffness, in both modes. It compiles too long for a test.

    python -m benchmarks.speed.woodpecker [--mode forward|reverse]

The cycle changes with them: dT/dp = T_p - T_a r_p / r_a, with a the angle at which the jammed bird turns, and r the
speed that it gains in a period.
"""

import argparse
import sys
import time

import jax
import jax.numpy as jnp
import numpy as np

from lagjax.scenes.woodpecker import PARAMS, TURN, lap, motion

jax.config.update("jax_enable_x64", True)
# Finite differences, with steps of 1e-5, of the independent computation that `tests/scenes/test_woodpecker.py` tells of.
INDEPENDENT = {"mu": -0.61604757, "c": -10.2963651}


def of_parameters(given):
    """The period and the speed that the bird gains, as functions of (turn, mu, c)."""
    turn, mu, c = given
    found = lap(motion(PARAMS | {"mu": mu, "c": c}, np.array([0.0, 0.18]), turn, estimate_error=False))
    return jnp.stack([found.period, found.gained])


def main():
    """Print the derivatives next to the independent ones, and fail if they differ by more than 1e-6."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--mode", choices=("forward", "reverse"), default="forward")
    mode = parser.parse_args().mode
    start = time.perf_counter()
    slopes = jax.jit((jax.jacfwd if mode == "forward" else jax.jacrev)(of_parameters))
    (of_turn, *direct), (gain_of_turn, *gains) = np.asarray(slopes(jnp.array([TURN, PARAMS["mu"], PARAMS["c"]])))
    print(f"{mode} mode, {time.perf_counter() - start:.0f} s with its compilation")
    worst = 0.0
    for (name, expected), slope, gain in zip(INDEPENDENT.items(), direct, gains):
        found = slope - of_turn * gain / gain_of_turn
        worst = max(worst, abs(found / expected - 1))
        print(f"  dT/d{name:<3} {found:+.9g}, independently {expected:+.9g}; at one turn alone {slope:+.9g}")
    sys.exit(not worst < 1e-6)


if __name__ == "__main__":
    main()
