"""Comparisons that several tests look at, and a program whose errors are made up."""

from copy import copy
from importlib import import_module

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.work_precision.methods import ComparedMotion
from tests.systems import motion
from tests.work_precision.test_work_precision import compared, swing

MODULES = [import_module(f"lagjax.work_precision.{name}") for name in ("work_precision", "references")]


class MadeUp:
    """In place of a `TimedProgram`: the motion released at rest, off by what a method of an order makes of n steps.

    Its error is 0.02 (100/n)^order, at least a few round-offs, of opposite signs for orders 8 and 12, and larger where
    the motion starts next to the top. With `max_steps` n must not be larger.
    """

    compile_seconds = 0.5
    orders = {"Nystrom12": 12, "Dopri8": 8, "Tsit5": 5, "Radau5": 5}

    def __init__(self, of: ComparedMotion, method):
        self.of, self.order = of, self.orders[type(method).__name__]

    def __call__(self, tolerance, ts=None, q=None, v=None):
        ts = np.asarray(self.of.ts if ts is None else ts)
        n = int(100 * (0.02 / float(tolerance)) ** (1 / self.order)) + 1
        error = max(0.02 * (100 / n) ** self.order, 4e-15) * (-1) ** (self.order // 4)
        error /= min(float(np.pi - self.of.start.q), 1.0)
        well = n <= self.of.options.get("max_steps", np.inf)
        code = lj.RESULTS.successful if well else lj.RESULTS.max_steps_reached
        angle, rate = (x * (1 + error) if well else np.full(len(ts), np.nan) for x in swing(ts))
        new = ts, angle, rate, ts[-1], angle[-1], rate[-1], n, code._value
        return eqx.tree_at(
            lambda x: (x.t, x.q, x.v, x.end.t, x.end.q, x.end.v, x.stats["num_steps"], x.result._value),
            motion("pendulum"),
            tuple(map(jnp.asarray, new[:-1])) + new[-1:],
        )

    def at(self, ts):
        """The same at other times."""
        other = copy(self)
        other.of = self.of._replace(ts=ts)
        return other

    def call(self, tolerance):
        """Tighter tolerances take longer."""
        return lambda: sum(range(int(100 * float(tolerance) ** (-1 / self.order))))

    def call_seconds(self):
        """That of a call that does nothing."""
        return 1e-7


@pytest.fixture
def made_up(monkeypatch):
    """Comparisons compile and solve nothing."""
    for module in MODULES:
        monkeypatch.setattr(module, "TimedProgram", MadeUp)


@pytest.fixture(scope="module")
def found():
    """A comparison with all defaults, whose errors are made up."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        for module in MODULES:
            monkeypatch.setattr(module, "TimedProgram", MadeUp)
        return compared()


@pytest.fixture(scope="module")
def solved():
    """A comparison of one method with the closed form."""
    return compared(methods=[lj.Tsit5()], tolerances=(1e-3, 1e-5, 1e-7, 1e-9), reference=swing)
