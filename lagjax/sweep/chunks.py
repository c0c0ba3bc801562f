"""The files of a store's arrays, one for each block: numbers, compressed by zstd, then their checksum (crc32c).

They are those that zarr writes and reads. A file may come from anyone: no more bytes are made of one than its block has
numbers for.
"""

import math
import os
import uuid
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

# The length of a checksum in bytes.
CHECKSUM = 4
NEEDS_ZARR = 'stores need zarr, which is an optional extra.\nFix: pip install "lagjax[data]", or leave store out.'
# The exceptions for files that are missing or damaged.
UNREADABLE = (ValueError, RuntimeError, TypeError, OSError)
# The first bytes of a zstd frame, and the lengths of the fields after them.
ZSTD, DICTIONARY, CONTENT = b"\x28\xb5\x2f\xfd", (0, 1, 2, 4), (0, 2, 4, 8)


class Spec(NamedTuple):
    """How an array lies in its files: in chunks of one shape, compressed or not, in the order of their bytes."""

    shape: tuple[int, ...]
    chunk: tuple[int, ...]
    dtype: np.dtype
    fill: float
    dims: list[str] | None
    compressed: bool = True

    @property
    def bytes(self) -> int:
        """The bytes of the whole array."""
        return math.prod(self.shape) * self.dtype.itemsize

    @property
    def chunk_bytes(self) -> int:
        """The bytes of one chunk, before it is compressed."""
        return math.prod(self.chunk) * self.dtype.itemsize

    def metadata(self, attributes: dict[str, Any]) -> dict[str, Any]:
        """What zarr 3 says of such an array in its `zarr.json`."""
        fill = "NaN" if self.fill != self.fill else self.dtype.type(self.fill).item()
        order = {} if self.dtype.itemsize == 1 else {"configuration": {"endian": "little"}}
        zstd = [{"name": "zstd", "configuration": {"level": 0, "checksum": False}}] if self.compressed else []
        return {
            "zarr_format": 3,
            "node_type": "array",
            "shape": list(self.shape),
            "data_type": str(self.dtype),
            "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": list(self.chunk)}},
            "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
            "fill_value": [fill, 0.0] if self.dtype.kind == "c" else fill,
            "codecs": [{"name": "bytes"} | order, *zstd, {"name": "crc32c"}],
            "attributes": attributes,
            **({} if self.dims is None else {"dimension_names": self.dims}),
            "storage_transformers": [],
        }


def chunk_file(folder: Path, spec: Spec, place: tuple[int, ...] = ()) -> Path | None:
    """The file of a chunk, the first along the dimensions that `place` does not name; None for an empty array."""
    inner = "0" * (len(spec.shape) - len(place))
    return None if math.prod(spec.shape) == 0 else folder.joinpath("c", *map(str, place), *inner)


def read_bytes(file: Path, spec: Spec) -> bytes:
    """The bytes of one file, which are those of its chunk, compressed.

    **Raises:** one of `UNREADABLE` if there is no such file, or it holds anything else.
    """
    with open(file, "rb") as content:
        # Numbers that cannot be compressed take little more than they are.
        if os.fstat(content.fileno()).st_size > spec.chunk_bytes + spec.chunk_bytes // 64 + 1024:
            raise ValueError(f"{file} is longer than its numbers.")
        data = content.read()
    body = data[:-CHECKSUM]
    if checksum_of(body) != as_number(data[-CHECKSUM:]):
        raise ValueError(f"{file} is not as it was written.")
    if (content_size(body) if spec.compressed else len(body)) != spec.chunk_bytes:
        raise ValueError(f"{file} does not hold {spec.chunk_bytes:,} bytes.")
    return body


def read_chunk(file: Path | None, spec: Spec) -> np.ndarray:
    """The numbers of one file, in the shape of a chunk; zeros for an empty array (None).

    **Raises:** as `read_bytes`.
    """
    if file is None:
        return np.zeros(spec.chunk, spec.dtype)
    data = read_bytes(file, spec)
    body = np.empty(spec.chunk_bytes, np.uint8) if spec.compressed else np.frombuffer(data, np.uint8)
    if spec.compressed:
        _zstd().decode(data, out=body)
    if spec.dtype.kind == "b" and body.max(initial=0) > 1:
        raise ValueError(f"{file} has truth values that are neither true nor false.")
    return body.view(spec.dtype.newbyteorder("<")).reshape(spec.chunk)


def write_chunk(file: Path | None, spec: Spec, x: np.ndarray) -> tuple[int, int]:
    """Write the numbers of one file, (n, ...) up to the shape of a chunk; returns its length and its checksum.

    There is no file (None), of length 0, for an empty array.
    """
    if file is None:
        return 0, 0
    whole = np.zeros(spec.chunk, spec.dtype.newbyteorder("<"))
    whole[tuple(map(slice, x.shape))] = x
    body = bytes(_zstd().encode(whole)) if spec.compressed else whole.tobytes()
    checksum = checksum_of(body)
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f"{file.name}.{uuid.uuid4().hex[:8]}.partial")
    partial.write_bytes(body + checksum.to_bytes(CHECKSUM, "little"))
    partial.replace(file)
    return len(body) + CHECKSUM, checksum


def content_size(frame: bytes) -> int | None:
    """How many bytes a zstd frame says that it holds; None if it does not say it (RFC 8878, 3.1.1.1)."""
    if frame[:4] != ZSTD or len(frame) < 5:
        return None
    single, length = frame[4] >> 5 & 1, CONTENT[frame[4] >> 6]
    length = 1 if single and length == 0 else length
    start = 5 + (1 - single) + DICTIONARY[frame[4] & 3]
    return as_number(frame[start : start + length]) + (256 if length == 2 else 0) if length else None


def as_number(data: bytes) -> int:
    """Bytes as a number, the lowest first."""
    return int.from_bytes(data, "little")


def checksum_of(data: bytes) -> int:
    """The checksum of some bytes."""
    try:
        # A dependency of zarr, which uses it for the same checksums.
        from google_crc32c import value
    except ImportError as error:
        raise ImportError(NEEDS_ZARR) from error
    return value(data)


def _zstd():
    try:
        # A dependency of zarr, which compresses with it.
        from numcodecs.zstd import Zstd
    except ImportError as error:
        raise ImportError(NEEDS_ZARR) from error
    return Zstd(level=0)
