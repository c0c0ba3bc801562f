"""How stores are filled: what is missing is computed again, also by other versions."""

import pytest

import lagjax as lj
from lagjax.sweep import metadata
from tests.sweep.small_stores import AXES, remove, rewrite, run, same, swept


def by_another_version(description):
    """Pretend that another version, which traced another program, wrote the store."""
    description["fingerprint"] |= {"versions": metadata.versions() | {"jax": "0.9.0"}, "program": "0" * 16}


def test_other_versions(store):
    """Their stores can always be read, and continued on request; a different run is detected by its values."""
    rewrite(store, by_another_version)
    remove(store / "lagjax/marks/c/4/0/0")
    opened = lj.open_sweep(store)
    assert opened.counts() == {"successful": 32, "not run": 8} and "written by lagjax" in opened.how
    with pytest.raises(ValueError, match="written by other versions(.|\n)*jax: 0.9.0 there(.|\n)*accept_versions=True"):
        swept(store)
    with pytest.warns(UserWarning, match="of 8 points computed again, 'y' differs by 1.0e"):
        swept(store, lambda point: {"n": run(point)["n"], "y": 2 * run(point)["y"]}, accept_versions=True, part=(0, 9))
    continued = swept(store, accept_versions=True)
    assert continued.ran == 8
    same(continued.values)
    with pytest.raises(ValueError, match="axis 'x' has other values"):
        swept(store, axes=AXES | {"x": AXES["x"] + 1}, accept_versions=True)
    rewrite(store, lambda description: description["fingerprint"].update(format=99))
    with pytest.raises(ValueError, match="which is newer"):
        lj.open_sweep(store)
