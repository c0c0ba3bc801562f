"""Blocks of arrays in files: those that zarr writes, each with a checksum, and no more than they have numbers for."""

import json
import tracemalloc

import numpy as np
import pytest
from numcodecs.zstd import Zstd

from lagjax.sweep.engine import nothing
from lagjax.sweep.objects import Damaged, Encoder, Files, Spec, checksum_of, decoded, ending


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint64", "float16", "float32", "complex128"])
@pytest.mark.parametrize("compressed", [True, False])
def test_zarr_reads_and_writes_the_same(tmp_path, dtype, compressed):
    """Zarr reads the blocks, of which the last is shorter, and a block of fill values has a file; it writes the same.

    A flipped bit is found by both.
    """
    import zarr

    x = np.arange(15).reshape(5, 3).astype(dtype)
    spec = Spec((5, 3), (2, 3), x.dtype, nothing(x.dtype), ["a", "b"], compressed)
    x[2:4] = spec.fill
    encoder, metadata, files = Encoder(spec), {}, Files(tmp_path / "ours")
    spec.made(metadata, "", {"about": "x"})
    contents = {spec.key((i,)): encoder((i, 0), x[2 * i : 2 * i + 2]) for i in range(3)}
    files.write({name: content.to_bytes() for name, content in metadata.items()} | contents)
    assert set(files.sizes()) == {"zarr.json", "c/0/0", "c/1/0", "c/2/0"}
    array = zarr.open_array(tmp_path / "ours")
    np.testing.assert_array_equal(array[:], x)
    assert array.attrs["about"] == "x" and json.loads(files.read(["zarr.json"])["zarr.json"])["dimension_names"] == [
        "a",
        "b",
    ]
    array[:2] = x[:2]
    assert files.read(["c/0/0"])["c/0/0"] == contents["c/0/0"]
    chunks = [decoded(content, spec) for content in contents.values()]
    np.testing.assert_array_equal(np.concatenate(chunks)[:5], x)
    first = bytearray(contents["c/0/0"])
    assert ending(first) == checksum_of(bytes(first[:-4]))
    first[0] ^= 4
    files.write({"c/0/0": bytes(first)})
    with pytest.raises(Damaged, match="is not as it was written"):
        decoded(bytes(first), spec)
    with pytest.raises(ValueError, match="checksum"):
        zarr.open_array(tmp_path / "ours")[:]


def repeated(n):
    """A frame of zstd that does not say how long its content is: n times 100 kB of zeros, in 4 bytes each."""
    block = lambda last: (last | 2 | 100_000 << 3).to_bytes(3, "little") + b"\0"
    return b"\x28\xb5\x2f\xfd\x00\x58" + block(0) * (n - 1) + block(1)


@pytest.mark.parametrize("body", [Zstd(level=1).encode(bytes(30_000_000)), repeated(300)])
def test_a_file_that_grows(body):
    """What would be more than the numbers of a block is not made. Twin: the same in a block that has so many."""
    file = bytes(body) + checksum_of(body).to_bytes(4, "little")
    spec = lambda n: Spec((n,), (n,), np.dtype(np.uint8), 0, None)
    tracemalloc.start()
    with pytest.raises(Damaged, match="is not as it was written"):
        decoded(file, spec(1000))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100_000 and not decoded(file, spec(30_000_000)).any()
