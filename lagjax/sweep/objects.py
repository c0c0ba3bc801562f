"""The files of a store, wherever it is: a folder, or a URL that fsspec opens; and the blocks of an array in them.

Zarr makes the files of blocks, in memory. What it does not promise is here: a file is written whole or not at all, a
missing one is an error and no block of fill values, and no more is made of a file than its block has numbers for, since
it may come from anyone. Zarr's shards would put several blocks into one file, which their writers then could not write
independently of each other.
"""

import math
import os
import uuid
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lagjax.files import Explained

# The length of a checksum in bytes.
CHECKSUM = 4
NEEDS_ZARR = 'stores need zarr, which is an optional extra.\nFix: pip install "lagjax[data]", or leave store out.'


class Files:
    """The files of a store by name, as bytes: a folder (a path), or anything else that fsspec opens (a URL)."""

    def __init__(self, place: str | os.PathLike):
        self.place: Path | str = place if isinstance(place, str) and "://" in place else Path(place)
        self._fs, self._root = _opened(self.place) if isinstance(self.place, str) else (None, "")
        self._folder, self._sizes = Path(self.place), None

    def at(self, name: str) -> str:
        """Where a file is, for messages."""
        return f"{str(self.place).rstrip('/')}/{name}"

    def sizes(self, again: bool = False) -> dict[str, int]:
        """The lengths of all files by name, as they were when they were listed first, or are now with `again`.

        **Raises:** `ValueError` for a link, or anything else that is neither a folder nor a file.
        """
        if self._sizes is not None and not again:
            return self._sizes
        if self._fs is None:
            self._sizes = dict(_in_folder(self._folder))
        else:
            self._fs.invalidate_cache()
            found = self._fs.find(self._root, detail=True)
            self._sizes = {name.removeprefix(self._root).lstrip("/"): about["size"] for name, about in found.items()}
        return self._sizes

    def read(self, names: Iterable[str]) -> dict[str, Any]:
        """The contents of some files, each bytes, or the error that it gave."""
        names = list(names)
        if self._fs is None:
            return {name: _content(self._folder / name) for name in names}
        if not names:
            return {}
        found = self._fs.cat([f"{self._root}/{name}" for name in names], on_error="return")
        return {name: found[f"{self._root}/{name}"] for name in names}

    def write(self, contents: dict[str, bytes]) -> None:
        """Write files, each whole or not at all."""
        if self._sizes is not None:
            self._sizes |= {name: len(content) for name, content in contents.items()}
        if self._fs is not None:
            self._fs.pipe({f"{self._root}/{name}": content for name, content in contents.items()})
            return
        for name, content in contents.items():
            _partial(self._folder / name, content).replace(self._folder / name)

    def write_once(self, name: str, content: bytes) -> None:
        """Write a file unless it is there: of several processes, one writes it."""
        if self._fs is not None:
            try:
                self._fs.pipe_file(f"{self._root}/{name}", content, mode="create")
            except FileExistsError:
                pass
            return
        file = self._folder / name
        partial = _partial(file, content)
        try:
            os.link(partial, file)
        except FileExistsError:
            pass
        except OSError:
            # A file system without hard links.
            partial.replace(file)
        finally:
            partial.unlink(missing_ok=True)


def _opened(url: str):
    try:
        import fsspec
    except ImportError as error:
        raise ImportError(f"{url} needs fsspec.\nFix: pip install fsspec, or a path in place of a URL.") from error
    try:
        return fsspec.core.url_to_fs(url)
    except ImportError as error:
        raise ImportError(f"{url} cannot be opened: {error}.\nFix: install what it names.") from error
    except ValueError as error:
        raise ValueError(f"{url} cannot be opened: {error}.\nFix: a path, or a URL of fsspec.") from error


def _in_folder(path: Path):
    folders = [""] if path.is_dir() else []
    while folders:
        inside = folders.pop()
        with os.scandir(path / inside) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    folders.append(f"{inside}{entry.name}/")
                elif entry.is_file(follow_symlinks=False):
                    yield inside + entry.name, entry.stat(follow_symlinks=False).st_size
                else:
                    what = "a link" if entry.is_symlink() else "not a file"
                    raise Explained(
                        f"{entry.path!r} is {what}, and a store has only files of its own.\n"
                        "Usual cause: a copy made of links; or a store that was changed.\n"
                        "Fix: copy the files themselves (cp -rL), if you trust what they link to."
                    )


def _content(file: Path):
    try:
        return file.read_bytes()
    except OSError as error:
        return error


def _partial(file: Path, content: bytes):
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_name(f"{file.name}.{uuid.uuid4().hex[:8]}.partial")
    partial.write_bytes(content)
    return partial


class Spec(NamedTuple):
    """An array in its files: in chunks of one shape, compressed by zstd or not, each with a checksum (crc32c)."""

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

    def key(self, place: tuple[int, ...] = ()) -> str:
        """The name of a chunk, the first along the dimensions that `place` does not name; "" for an empty array."""
        inner = "0" * (len(self.shape) - len(place))
        return "" if math.prod(self.shape) == 0 else "/".join(("c", *map(str, place), *inner))

    def made(self, files: dict[str, Any], name: str = "", attributes: dict[str, Any] | None = None) -> Any:
        """The array, as zarr makes it, over files in memory."""
        zarr = needed()
        codecs = [zarr.codecs.ZstdCodec(level=0)] * self.compressed + [zarr.codecs.Crc32cCodec()]
        # A block of fill values is a file as well: without one it would count as lost.
        return zarr.create_array(
            zarr.storage.MemoryStore(files), name=name or None, shape=self.shape, chunks=self.chunk, dtype=self.dtype,
            compressors=codecs, fill_value=self.fill, dimension_names=self.dims, attributes=attributes or {},
            config={"write_empty_chunks": True},
        )  # fmt: skip


class Encoder:
    """Makes the files of an array's chunks: zarr writes them in memory."""

    def __init__(self, spec: Spec):
        self.spec, self._files = spec, {}
        self._array = spec.made(self._files)

    def __call__(self, place: tuple[int, ...], x: np.ndarray) -> bytes:
        """The file of a chunk, at the place that `Spec.key` names; b"" for an empty array."""
        if not self.spec.key():
            return b""
        region = tuple(slice(i * k, i * k + n) for i, k, n in zip(place, self.spec.chunk, x.shape))
        self._array[region] = x
        return self._files.pop(self.spec.key(place)).to_bytes()


def needed() -> Any:
    """The module zarr.

    **Raises:** `ImportError` if it is not installed.
    """
    try:
        import zarr
    except ImportError as error:
        raise ImportError(NEEDS_ZARR) from error
    return zarr


def consolidated(files: dict[str, Any]) -> None:
    """Put the metadata of all arrays into that of the group above them, where xarray reads them at once."""
    with warnings.catch_warnings():
        # That other readers than zarr-python's may not know them yet.
        warnings.simplefilter("ignore")
        needed().consolidate_metadata(needed().storage.MemoryStore(files))


def most_of(spec: Spec) -> int:
    """How long the file of a chunk may be: numbers that cannot be compressed take little more than they are."""
    return spec.chunk_bytes + spec.chunk_bytes // 64 + 1024


def decoded(content: Any, spec: Spec) -> np.ndarray:
    """The numbers of a file of a chunk, by its content, or by the error that reading it gave.

    No more is made of it than its chunk has numbers for, where zarr would make as much as the file says.

    **Raises:** `Damaged`, which says what is wrong.
    """
    if isinstance(content, FileNotFoundError):
        raise Damaged("is missing")
    if isinstance(content, OSError):
        raise Damaged(f"cannot be read ({content.strerror or content})")
    if not isinstance(content, Exception) and CHECKSUM < len(content) <= most_of(spec):
        body = content[:-CHECKSUM]
        room = np.zeros(spec.chunk_bytes, np.uint8) if spec.compressed else np.frombuffer(body, np.uint8)
        try:
            if checksum_of(body) == ending(content) and len(room) == spec.chunk_bytes:
                if spec.compressed:
                    _zstd().decode(body, out=room)
                if spec.dtype.kind != "b" or room.max(initial=0) <= 1:
                    return room.view(spec.dtype.newbyteorder("<")).reshape(spec.chunk)
        except (ValueError, RuntimeError):
            pass
    raise Damaged("is not as it was written")


class Damaged(ValueError):
    """What is wrong with a file, in words."""


def ending(content: bytes) -> int:
    """The checksum at the end of a file."""
    return int.from_bytes(content[-CHECKSUM:], "little")


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
