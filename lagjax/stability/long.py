"""Very many periods of a pendulum that swings or turns over the top."""

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.report import MAIN
from lagjax.scenes import bead_on_hoop
from lagjax.stability.hoop_and_wedge import by_both, swing
from lagjax.stability.trial import DEGRADED, REFUSED, Trial
from lagjax.system import System


def pendulum(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ v² + cos q."""
    return 0.5 * v**2 + jnp.cos(q)


rotor = System(pendulum)
UNIT = {"a": 1.0, "g": 1.0, "omega": 0.0}


def _whole_turns(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """Direction and rate near whole turns, after which the pendulum is back at the bottom with the rate v0."""
    period = bead_on_hoop.rotation_period(UNIT, v0**2 - 2.0)
    over = v0 * (ts - jnp.round(ts / period) * period)
    return jnp.stack([jnp.cos(over), jnp.sin(over)]), v0 + 0 * ts


def _direction(trajectory):
    # The relative error of an angle of six million radians would hide a phase error.
    return jnp.stack([jnp.cos(trajectory.q), jnp.sin(trajectory.q)]), trajectory.v


def long():
    """From a hundred to a million periods."""
    omega = {"omega": 0.0}
    rate, per_turn = 100.0, 24
    turn = float(bead_on_hoop.rotation_period(UNIT, rate**2 - 2.0))
    # Steps at equal angles: their errors due to a weak periodic force cancel over a turn.
    fixed = {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": np.asarray(turn / per_turn), "max_steps": None}

    def turns(n: float, **what):
        return Trial(
            "long", f"{n:.0e} turns, {per_turn} fixed steps each", rotor, 0.0, rate, {}, np.array([0.0, n * turn]),
            _whole_turns, method=diffrax.Tsit5(), tolerance=1e-9, options=fixed, observed=_direction, periods=n, **what,
        )  # fmt: skip

    return [
        *by_both(
            [
                swing("1e2 periods", omega, 1.0, 100.3, family="long", tier=MAIN),
                swing("1e3 periods", omega, 1.0, 1000.3, family="long"),
                swing("1e4 periods", omega, 1.0, 10000.3, family="long", derived=False, expected=None),
            ]
        ),
        swing("1e6 periods, as they come", omega, 1.0, 1e6, family="long", derived=False, expected=REFUSED),
        swing(
            "1e6 periods at 1e-4",
            omega,
            1.0,
            1e6 + 0.3,
            family="long",
            derived=False,
            expected=DEGRADED,
            tolerance=1e-4,
            method=diffrax.Tsit5(),
            options={"max_steps": None},
        ),  # fmt: skip
        turns(1e4),
        turns(1e6),
    ]
