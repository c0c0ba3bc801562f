"""Single precision that nobody asked for gives one warning, at the first function called, at the user's line."""

import inspect
import subprocess
import sys
import warnings
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.system import coordinates

free = lj.System(lambda t, q, v, params: 0.5 * v**2)
TS = np.linspace(0.0, 1.0, 2)


@pytest.fixture
def untold(monkeypatch):
    """A process without x64 in which nothing has warned yet."""
    monkeypatch.setattr(coordinates, "_settled", [])
    monkeypatch.delenv("JAX_ENABLE_X64", raising=False)
    jax.config.update("jax_enable_x64", False)
    yield
    jax.config.update("jax_enable_x64", True)


def told(act):
    """The warnings that a call issues, with their lines."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        act()
    return [(each.category, each.filename, each.lineno) for each in found]


@pytest.mark.parametrize("number", (1.0, 1, np.float64(1.0), np.ones(()), np.int32(1)))
def test_told_once(untold, number):
    """Only the first state that is not NumPy float32 warns; the message has the line that changes it."""
    for count in (1, 0):
        found = told(lambda: coordinates.state(0.0, number, number, None))
        assert [kind for kind, *_ in found] == [lj.PrecisionWarning] * count
    coordinates._settled.clear()
    with pytest.warns(lj.PrecisionWarning, match=r'(?s)1e-7.*Fix: jax.config.update\("jax_enable_x64", True\) before'):
        coordinates.state(0.0, number, number, None)


@pytest.mark.parametrize(
    "meant",
    (
        (0.0, np.float32(1.0), np.float32(1.0), None),
        (0.0, np.ones(2, np.float32), np.ones(2, np.float32), None),
        (0.0, 1.0, 1.0, {"w": np.ones(2, np.float32)}),
    ),
)
def test_not_told_where_it_is_meant(untold, meant):
    """NumPy float32 in a state or the parameters shows that it is meant, from then on."""
    assert told(lambda: coordinates.state(*meant)) == []
    assert told(lambda: coordinates.state(0.0, 1.0, 1.0, None)) == []


def test_not_told_where_it_is_said(untold, monkeypatch):
    """Said in the environment, or for a part of the code alone; twin: where it is not, a state warns."""
    monkeypatch.setenv("JAX_ENABLE_X64", "0")
    assert told(lambda: coordinates.state(0.0, 1.0, 1.0, None)) == []
    monkeypatch.delenv("JAX_ENABLE_X64")
    coordinates._settled.clear()
    jax.config.update("jax_enable_x64", True)
    with jax.enable_x64(False):
        assert told(lambda: coordinates.state(0.0, 1.0, 1.0, None)) == []
    coordinates._settled.clear()
    jax.config.update("jax_enable_x64", False)
    assert len(told(lambda: coordinates.state(0.0, 1.0, 1.0, None))) == 1


def test_not_told_with_x64(monkeypatch):
    """Twin: with x64 nothing warns, not even float32."""
    monkeypatch.setattr(coordinates, "_settled", [])
    assert told(lambda: [coordinates.state(0.0, x, x, None) for x in (1.0, jnp.float32(1.0))]) == []


DOORS = {
    "integrate": (lambda: lj.integrate(free, 1.0, 0.0, None, ts=TS, rtol=1e-9), ValueError),
    "in a program": (lambda: jax.eval_shape(lambda q: lj.momentum(free, 0.0, q, q, None), 1.0), None),
    "symmetries": (lambda: lj.symmetries(free, 1.0, 0.0, None, basis=[lj.Generator(lambda t: 1.0)]), TypeError),
    "equilibria": (lambda: lj.equilibria(free, starts=[1.0], cyclic="no such"), ValueError),
    "normal_modes": (lambda: lj.normal_modes(lj.System(lambda t, q, v: v), 0.0, 1.0, 0.0, None), TypeError),
}


@pytest.mark.parametrize("door", DOORS)
def test_told_at_the_users_line(untold, door):
    """Whichever function comes first, also through JAX's tracing, the warning is at the line of this file."""
    act, error = DOORS[door]

    def called():
        if error is None:
            act()
        else:
            with pytest.raises(error):
                act()

    [(kind, file, line)] = told(called)
    assert kind is lj.PrecisionWarning and file == __file__
    assert line == inspect.getsourcelines(act)[1]


@pytest.mark.slow
def test_a_process_of_its_own():
    """A motion without x64 warns once, at its line; as an error it is raised; ignored by its class it is silent."""
    code = """
import warnings, numpy as np, lagjax as lj
free = lj.System(lambda t, q, v, params: 0.5 * v**2)
move = lambda: lj.integrate(free, 1, 1, None, ts=np.array([0, 1])).q[-1]
warnings.simplefilter("error")
try:
    move()
except lj.PrecisionWarning:
    print("raised")
warnings.filterwarnings("ignore", category=lj.PrecisionWarning)
print(move())
"""
    found = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(lj.__file__).parents[1], capture_output=True, text=True, check=True
    ).stdout
    assert found.split() == ["raised", "2.0"]
