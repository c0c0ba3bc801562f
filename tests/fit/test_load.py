"""Fits saved to files and loaded bit for bit, with the functions passed again."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.files import npz
from lagjax.files.table import Table

T = np.linspace(0.0, 3.0, 16)


def swing(t, q, v, params):
    """A spring of stiffness k."""
    return 0.5 * v["x"] ** 2 - 0.5 * params["k"] * q["x"] ** 2


def squared(t, q, v, params):
    """The observed quantity."""
    return {"d": q["x"] ** 2}


spring = lj.System(swing)
NOISE = 1e-3 * np.random.default_rng(0).normal(size=len(T))


def check(found, path, *given):
    """Save and load a fit: arrays are equal bit for bit, everything else is equal and prints the same."""
    found.save(path)
    again = lj.load_fit(path, *given)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        same = np.asarray(a).tobytes() == np.asarray(b).tobytes() if isinstance(a, (jax.Array, np.ndarray)) else a == b
        assert type(a) is type(b) and same
    assert jax.tree.structure(found) == jax.tree.structure(again) and repr(found) == repr(again)
    return again


@pytest.mark.exhaustive
def test_saved_and_loaded(tmp_path):
    """With its functions a loaded fit is complete; without, it has its results, and says what is missing."""
    path, guess = tmp_path / "fit.npz", {"k": 3.5}
    record = lj.Record(T, q={"x": np.cos(2.0 * T) + NOISE}, observed={"d": np.cos(2.0 * T) ** 2 + NOISE}, sigma=1e-3)
    found = lj.fit(spring, record, guess, observe=squared)
    again = check(found, path, spring, squared)
    np.testing.assert_array_equal(again.motion().q["x"], found.motion().q["x"])
    without = lj.load_fit(path)
    assert repr(without) == repr(found) and without.params == found.params
    np.testing.assert_array_equal(without.sd, found.sd)
    np.testing.assert_array_equal(without.start_sd[0][0]["x"], found.start_sd[0][0]["x"])
    np.testing.assert_array_equal(without.residuals()["d"], found.residuals()["d"])
    for ask in (without.motion, without.laplace):
        with pytest.raises(ValueError, match=r"needs the functions of the system \(System\(swing\)\)"):
            ask()
    check(without, path)
    half = lj.load_fit(path, spring)
    with pytest.raises(ValueError, match=r"needs observe, .*\n.*load_fit\(path, system, observe=...\)"):
        half.laplace()
    stiffer = lj.System(lambda t, q, v, params: swing(t, q, v, {"k": 2 * params["k"]}))
    with pytest.raises(ValueError, match="the Lagrangian: its value was"):
        lj.load_fit(path, stiffer)
    with pytest.raises(TypeError, match="has no events to be passed again"):
        lj.load_fit(path, spring, events={})
    with pytest.raises(ValueError, match=r"holds a fit, not a trajectory.\nFix: lj.load_fit"):
        lj.load_trajectory(path)


class Own(eqx.Module):
    """A module of the user's, with a layer in a list, and an activation."""

    layers: list
    activation: Callable

    def __call__(self, x):
        """A number."""
        return jnp.sum(self.activation(self.layers[0](x)))


def networks():
    """Modules of equinox, of lagjax and of the user, and arrays in a dictionary, as flax has them."""
    keys = iter(jax.random.split(jax.random.key(0), 8))
    return {
        "mlp": eqx.nn.MLP(1, "scalar", 3, 1, jax.nn.softplus, key=next(keys)),
        "linear": eqx.nn.Linear(1, "scalar", key=next(keys)),
        "in turn": eqx.nn.Sequential([eqx.nn.Linear(1, 3, key=next(keys)), eqx.nn.Lambda(jnp.tanh)]),
        "conv": eqx.nn.Conv1d(1, 2, 1, key=next(keys)),
        "own": Own([eqx.nn.Linear(1, 2, key=next(keys))], jnp.sin),
        "learned": lj.learned.Network({"x": 1.0}, key=next(keys), width=3, first=0.1),
        "mass": lj.learned.Network({"x": 1.0}, key=next(keys), width=3, first=0.1, out=1),
        "flax": {"params": {"Dense_0": {"kernel": jnp.full((1, 2), 0.3), "bias": jnp.zeros(2)}}},
    }


@pytest.mark.slow
def test_networks_alone():
    """Networks of eight kinds come back from JSON and arrays; twin: without a class of the user's they do not."""
    writer, nets = npz.Writer(), networks()
    node = writer.down(nets, "net")
    read = lambda *classes: npz.Reader(dict(writer.arrays).pop, table=Table(classes)).up(node)
    again = read(Own)
    assert eqx.tree_equal(nets, again) and again["own"].activation is jnp.sin
    with pytest.raises(ValueError, match="(?s)class .*Own"):
        read()
