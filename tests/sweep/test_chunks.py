"""Blocks of arrays in files: those that zarr would write, with a checksum in each."""

import json
import shutil

import numpy as np
import pytest

from lagjax.sweep.engine import nothing
from lagjax.sweep.metadata import Spec, chunk_file, read_chunk, write_chunk
from tests.sweep.small_stores import flip_bit


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint64", "float16", "float32", "complex128"])
@pytest.mark.parametrize("compressed", [True, False])
def test_zarr_would_write_the_same(tmp_path, dtype, compressed):
    """Metadata and files are those that zarr writes, in meaning; zarr reads them, and detects a flipped bit."""
    import zarr
    from zarr.codecs import Crc32cCodec, ZstdCodec

    x = np.arange(15).reshape(5, 3).astype(dtype)
    spec = Spec((5, 3), (2, 3), x.dtype, nothing(x.dtype), ["a", "b"], compressed)
    codecs = [ZstdCodec(level=0)] * compressed + [Crc32cCodec()]
    zarr.create_array(
        tmp_path / "zarr", shape=x.shape, chunks=spec.chunk, dtype=dtype, compressors=codecs,
        fill_value=spec.fill, dimension_names=spec.dims, attributes={"about": "x"},
    )[:] = x  # fmt: skip
    theirs = json.loads((tmp_path / "zarr/zarr.json").read_text())
    assert spec.metadata({"about": "x"}) == theirs
    for i in range(3):
        file = chunk_file(tmp_path / "ours", spec, (i,))
        length, checksum = write_chunk(file, spec, x[2 * i : 2 * i + 2])
        assert length == file.stat().st_size and file.read_bytes()[-4:] == checksum.to_bytes(4, "little")
        here = chunk_file(tmp_path / "zarr", spec, (i,))
        np.testing.assert_array_equal(read_chunk(here, spec)[: len(x) - 2 * i], x[2 * i : 2 * i + 2])
        shutil.copy(file, here)
    np.testing.assert_array_equal(zarr.open_array(tmp_path / "zarr")[:], x)
    flip_bit(0)(chunk_file(tmp_path / "zarr", spec, (0,)))
    with pytest.raises(ValueError, match="checksum"):
        zarr.open_array(tmp_path / "zarr")[:]
