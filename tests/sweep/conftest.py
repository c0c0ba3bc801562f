"""A store that several tests damage."""

import shutil

import pytest

from lagjax.sweep.objects import Files
from lagjax.sweep.store import Store
from tests.sweep.small_stores import swept


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An intact store."""
    path = tmp_path_factory.mktemp("whole") / "store"
    assert swept(path).ran == 40 and Store(Files(path)).blocks.block == (1, 8)
    return path


@pytest.fixture
def store(whole, tmp_path):
    """A copy of the intact store, to be damaged."""
    return shutil.copytree(whole, tmp_path / "store")
