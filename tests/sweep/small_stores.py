"""A sweep in a store of five blocks, in closed form, and ways to damage its files."""

import shutil
import warnings

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import lagjax as lj
from lagjax.integrate.solve.reports import report
from tests.mutated import describe

AXES = {"k": np.arange(1, 6), "x": np.linspace(0.1, 1.0, 8)}
EXACT = {"n": 10 + AXES["k"][:, None] * np.ones(8, int), "y": np.stack([AXES["k"][:, None] * AXES["x"]] * 2, -1)}


def run(point):
    """An integer and two floats, in closed form."""
    return {"n": 10 + point["k"], "y": jnp.stack([point["x"] * point["k"]] * 2)}


def swept(path, of=run, axes=AXES, **settings):
    """The sweep in a store of five blocks with eight points each."""
    return lj.sweep(of, axes, store=path, chunk=8, workers=1, progress=False, **settings)


def scaled(traj, factor):
    """A finished motion times a factor, with its report: what `integrate` gives a sweep, without a solver."""
    return report(eqx.tree_at(lambda x: (x.q, x.v), traj, (factor * traj.q, factor * traj.v)))


def with_warnings(call):
    """(what a call returns, its warnings)."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        return call(), "\n".join(str(x.message) for x in caught)


def same(values, where=...):
    """Check values against the closed form."""
    for name, exact in EXACT.items():
        np.testing.assert_allclose(values[name][where], exact[where], rtol=1e-15)


def remove(file):
    """Remove a file or a folder."""
    if file.is_dir():
        shutil.rmtree(file)
    else:
        file.unlink()


def cut(file):
    """Cut a file to its first half."""
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def empty(file):
    """Empty a file, as after a power cut."""
    file.write_bytes(b"")


def flip_bit(at):
    """A function that flips one bit."""

    def flip(file):
        data = bytearray(file.read_bytes())
        data[at] ^= 4
        file.write_bytes(data)

    return flip


def exchange(file):
    """Replace the file by that of another block."""
    shutil.copy(str(file).replace("/c/1/", "/c/3/"), file)


def rewrite(path, change):
    """Change the description of a store."""
    describe(path, lambda description: change(description) or description)
