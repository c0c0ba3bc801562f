"""The files of a store's arrays, one for each block: numbers, compressed by zstd, then their checksum (crc32c).

Zarr writes them. They are read here, since a file may come from anyone: no more bytes are made of one than its block
has numbers for.
"""

import os
from pathlib import Path

import numpy as np

from lagjax.sweeps.described import Spec

# The length of a checksum in bytes.
CHECKSUM = 4
# The exceptions for files that are missing or damaged.
UNREADABLE = (ValueError, RuntimeError, TypeError, OSError)
# The first bytes of a zstd frame, and the lengths of the fields after them.
ZSTD, DICTIONARY, CONTENT = b"\x28\xb5\x2f\xfd", (0, 1, 2, 4), (0, 2, 4, 8)


def read_chunk(file: Path, spec: Spec) -> np.ndarray:
    """The numbers of one file, in the shape of a chunk.

    **Raises:** one of `UNREADABLE` if there is no such file, or it holds anything else.
    """
    expected = spec.chunk_bytes
    with open(file, "rb") as content:
        # Numbers that cannot be compressed take little more than they are.
        if os.fstat(content.fileno()).st_size > expected + expected // 64 + 1024:
            raise ValueError(f"{file} is longer than its numbers.")
        data = content.read()
    if checksum_of(data[:-CHECKSUM]) != as_number(data[-CHECKSUM:]):
        raise ValueError(f"{file} is not as it was written.")
    body = np.frombuffer(data, np.uint8)[:-CHECKSUM]
    if spec.compressed:
        if content_size(data) != expected:
            raise ValueError(f"{file} does not hold {expected:,} bytes.")
        body = _zstd().decode(body, out=np.empty(expected, np.uint8))
    elif len(body) != expected:
        raise ValueError(f"{file} does not hold {expected:,} bytes.")
    if spec.dtype.kind == "b" and body.max(initial=0) > 1:
        raise ValueError(f"{file} has truth values that are neither true nor false.")
    return body.view(spec.dtype.newbyteorder("<")).reshape(spec.chunk)


def read_array(folder: Path, spec: Spec) -> np.ndarray:
    """All numbers of an array, such as an axis, whose chunks are of any length.

    **Raises:** one of `UNREADABLE` if a file is damaged or missing. Zarr writes no file for zeros alone.
    """
    counts = tuple(-(-n // k) for n, k in zip(spec.shape, spec.chunk))
    if 0 in counts or counts == (1,) * len(counts) and not folder.joinpath("c", *"0" * len(counts)).exists():
        return np.zeros(spec.shape, spec.dtype)
    first = read_chunk(folder.joinpath("c", *"0" * len(counts)), spec)
    found = np.empty(spec.shape, spec.dtype)
    for place in np.ndindex(*counts):
        chunk = read_chunk(folder.joinpath("c", *map(str, place)), spec) if any(place) else first
        here = tuple(slice(i * k, min((i + 1) * k, n)) for i, k, n in zip(place, spec.chunk, spec.shape))
        found[here] = chunk[tuple(slice(x.stop - x.start) for x in here)]
    return found


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
    # A dependency of zarr, which uses it for the same checksums.
    from google_crc32c import value

    return value(data)


def _zstd():
    # A dependency of zarr, which compresses with it.
    from numcodecs.zstd import Zstd

    return Zstd()
