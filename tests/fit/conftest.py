"""A motion that several fits measure."""

import numpy as np
import pytest

import lagjax as lj
from tests.fit.cases import PENDULUM, TS, pendulum


@pytest.fixture(scope="module")
def swinging():
    """A pendulum's angle and rate at `TS`."""
    traj = lj.integrate(pendulum, 1.0, 0.0, PENDULUM, ts=TS)
    return np.asarray(traj.q), np.asarray(traj.v)
