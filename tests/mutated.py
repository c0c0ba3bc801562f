"""Files and stores changed as an attacker would change them: fields, names, lengths, depth, bombs, links."""

import io
import json
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
from google_crc32c import value as crc32c
from numcodecs.zstd import Zstd

from lagjax.sweep.metadata import digest_of

# What takes the place of a part of a description.
CODE = {"function": {"module": "os", "name": "system"}}
MODULE = {"namedtuple": {"module": "antigravity", "name": "X"}, "fields": {}}
PROGRAM = {"object": {"module": "numpy.f2py.__main__", "name": "X"}, "fields": {}}
PARTIAL = {"object": {"module": "equinox", "name": "Partial"}, "fields": {"func": CODE, "args": {"tuple": []}}}
OPENER = {"object": {"module": "subprocess", "name": "Popen"}, "fields": {"args": "touch RAN"}}
LAYER = {"object": {"module": "equinox.nn", "name": "Lambda"}, "fields": {"fn": CODE}}
ATOMS = [None, True, 0, -1, 7, 1.5, 10**12, -(10**30), "x", "", [], {}, [1], [[]], {"array": "t"}, {"given": "x"}]
ATOMS += [CODE, MODULE, PROGRAM, PARTIAL, OPENER, LAYER, {"float": "nan"}, {"complex": [1]}, {"dict": [[[], 1]]}]
ATOMS += [{"list": 3}, {"tuple": {"a": 1}}, {"key": "t", "impl": "os"}, {"dict": [["a", 1], ["a", 2]]}]
NAMES = [
    "os", "posix.system", "antigravity", "numpy.f2py.__main__", "../../elsewhere/x", "/tmp/elsewhere/x", "t", "", "..",
    "a/../../../x", "C:\\x", "\x1b[2J\x1b]0;title\x07", "</script><script>alert(1)</script>", "\u202e", "x" * 9999,
    "__class__", "__init__", "zarr.json", "lagjax", "object", "O", "|O", ">f8", "float64[1000000000000]", "values\x00",
]  # fmt: skip
TEXTS = [
    b"[1]", b"null", b'"format"', b"3", b"{}", b"", b"\xff\xfe", b"[" * 100_000, b'{"a":' * 50_000, b"nan",
    b"1" * 9999, b'{"format": "1"}', b'{"format": 1}', b'{"format": 1, "kind": []}',
    b'{"format": true, "kind": "fit"}', b"{" * 900,
    b'{"format": 1, "kind": "%s", "%s": ' + b"[" * 800 + b"]" * 800 + b"}", b'{"format": 99}', b'{"format": 0}',
    b'{"format": 1, "kind": "trajectory", "trajectory": [1]}', b'{"format": 1, "kind": "fit", "fit": null}',
]  # fmt: skip
HEADERS = [  # of npy
    "{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000000,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
    "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 4611686018427387904), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (3,), }",
    "{'descr': '<U0', 'fortran_order': False, 'shape': (1000000000000,), }",
    "{'descr': [('a', '<f8')], 'fortran_order': True, 'shape': (3,), }",
    "{'descr': '<f8', 'fortran_order': True, 'shape': 3, }",
    "{'descr': 'nonsense', 'fortran_order': False, 'shape': (), }",
    "__import__('os').system('touch RAN')",
    "(" * 5000,
    "[1] * 10 ** 10",
    "{",
]


def places(tree):
    """The places of all parts of a JSON tree."""
    found, left = [], [((), tree)]
    while left:
        at, inside = left.pop()
        items = inside.items() if isinstance(inside, dict) else enumerate(inside) if isinstance(inside, list) else ()
        left += [((*at, key), x) for key, x in items]
        found.append(at)
    return found[1:]


def part(tree, at):
    """The part of a JSON tree at a place."""
    for key in at:
        tree = tree[key]
    return tree


def mutate(tree, rng):
    """Change a JSON tree at random: parts exchanged, removed, replaced, renamed, wrapped, numbers changed."""
    tree = json.loads(json.dumps(tree))
    for _ in range(int(rng.integers(1, 3))):
        everywhere = places(tree)
        if not everywhere:
            return tree
        at, other = (everywhere[int(i)] for i in rng.integers(len(everywhere), size=2))
        inside, key = part(tree, at[:-1]), at[-1]
        how = int(rng.integers(8))
        if how == 0:
            inside[key] = json.loads(json.dumps(part(tree, other)))
        elif how == 1:
            mine, yours = inside[key], part(tree, other)
            inside[key] = json.loads(json.dumps(yours))
            if other[: len(at)] != at:
                part(tree, other[:-1])[other[-1]] = mine
        elif how == 2:
            del inside[key]
        elif how == 3:
            inside[key] = NAMES[int(rng.integers(len(NAMES)))]
        elif how == 4 and isinstance(inside, dict):
            inside[NAMES[int(rng.integers(len(NAMES)))]] = inside.pop(key)
        elif how == 5:
            for _ in range(int(rng.choice([1, 60, 150]))):
                inside[key] = {"tuple": [inside[key]]}
        elif how == 6:
            numbers = [x for x in everywhere if isinstance(part(tree, x), int)]
            if numbers:
                at = numbers[int(rng.integers(len(numbers)))]
                part(tree, at[:-1])[at[-1]] = int(rng.choice([-1, 0, 1, 3, 2**31, 10**12, 2**62]))
        else:
            inside[key] = ATOMS[int(rng.integers(len(ATOMS)))]
    return tree


def npy(header, data=b""):
    """An npy file with any header."""
    text = header.encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", min(len(text), 65535)) + text + data


def mutated_file(good: Path, to: Path, rng: np.random.Generator) -> str:
    """Write a changed copy of a file; returns what was changed."""
    with zipfile.ZipFile(good) as entries:
        contents = [(name, entries.read(name)) for name in entries.namelist()]
    header = json.loads(dict(contents)["lagjax.json"])
    arrays = [i for i, (name, _) in enumerate(contents) if name.endswith(".npy")]
    i = int(rng.choice(arrays))
    how = str(rng.choice(["description"] * 6 + ["text", "npy", "bytes", "entries", "entries", "bomb"]))
    compression, raw = zipfile.ZIP_STORED, None
    if how == "description":
        contents[0] = "lagjax.json", json.dumps(mutate(header, rng)).encode()
    elif how == "text":
        contents[0] = "lagjax.json", TEXTS[int(rng.integers(len(TEXTS)))]
    elif how == "npy":
        contents[i] = contents[i][0], npy(HEADERS[int(rng.integers(len(HEADERS)))], bytes(24))
    elif how == "entries":
        name, data = contents[i]
        other = contents[int(rng.choice(arrays))]
        which = int(rng.integers(8))
        if which == 0:
            contents.append((name, other[1]))
        elif which == 1:
            contents.append(contents[0])
        elif which == 2:
            del contents[i]
        elif which == 3:
            contents[i] = name, other[1]
        elif which == 4:
            contents[i] = name, data[: int(rng.integers(len(data)))]
        elif which == 5:
            contents[i] = name, data + bytes(int(rng.integers(1, 5000)))
        elif which == 6:
            contents[i] = NAMES[int(rng.integers(len(NAMES)))] + ".npy", data
        else:
            compression = zipfile.ZIP_DEFLATED
    elif how == "bomb":
        # A thousandth of its size: an array of zeros, or a description of spaces.
        compression, n = zipfile.ZIP_DEFLATED, 3_000_000
        if rng.integers(2):
            header = f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({n},), }}"
            contents[i] = contents[i][0], npy(header, bytes(8 * n))
        else:
            contents[0] = "lagjax.json", b" " * 8 * n + contents[0][1]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as entries:
        for name, data in contents:
            entries.writestr(name, data)
    raw = bytearray(buffer.getvalue())
    if how == "bytes":
        if rng.integers(3) == 0:
            raw = raw[: int(rng.integers(len(raw)))]
        for _ in range(int(rng.integers(1, 4))):
            raw[int(rng.integers(len(raw)))] ^= int(rng.integers(1, 256))
    to.write_bytes(raw)
    return how


def describe(store: Path, change) -> None:
    """Change the description of a store, with a digest that fits."""
    file = store / "lagjax/zarr.json"
    said = json.loads(file.read_text())
    description = change(said["attributes"]["lagjax"])
    if isinstance(description, dict):
        try:
            description["digest"] = digest_of(description)
        except RecursionError:
            pass
    said["attributes"] = {"lagjax": description}
    file.write_text(json.dumps(said))


def mark(store: Path, name: str, block: int) -> None:
    """Mark a block's file as what it is now, as an attacker would."""
    values = json.loads((store / "lagjax/zarr.json").read_text())["attributes"]["lagjax"]["places"]
    names = [*values["values"].values(), *values["status"].values()]
    file = store / f"lagjax/marks/c/{block}/0/0"
    of = list((store / name / "c" / str(block)).rglob("*"))[-1].read_bytes()
    marks = np.frombuffer(file.read_bytes()[:-4], "<u8").reshape(-1, 2).copy()
    marks[names.index(name)] = len(of), int.from_bytes(of[-4:], "little")
    file.write_bytes(marks.tobytes() + crc32c(marks.tobytes()).to_bytes(4, "little"))


def mutated_store(store: Path, outside: Path, rng: np.random.Generator) -> str:
    """Change a store in its place; returns what was changed. `outside`: a folder that links may lead to."""
    files = sorted(x for x in store.rglob("*") if x.is_file())
    chunks = [x for x in files if x.name != "zarr.json"]
    chunk, metadata = chunks[int(rng.integers(len(chunks)))], [x for x in files if x.name == "zarr.json"]
    how = str(rng.choice(["description"] * 6 + ["metadata", "text", "bytes", "link", "bomb", "pipe", "long"]))
    if how == "description":
        describe(store, lambda description: mutate(description, rng))
    elif how == "metadata":
        file = metadata[int(rng.integers(len(metadata)))]
        file.write_text(json.dumps(mutate(json.loads(file.read_text()), rng)))
    elif how == "text":
        text = TEXTS[int(rng.integers(len(TEXTS)))]
        for file in metadata if rng.integers(2) else [metadata[int(rng.integers(len(metadata)))]]:
            file.write_bytes(text)
    elif how == "bytes":
        data = bytearray(chunk.read_bytes())
        data = data[: int(rng.integers(len(data)))] if rng.integers(2) else data
        for _ in range(2 if data else 0):
            data[int(rng.integers(len(data)))] ^= int(rng.integers(1, 256))
        chunk.write_bytes(data)
    elif how == "link":
        target = [chunk, chunk.parent, store / "y", store / "lagjax"][int(rng.integers(4))]
        os.rename(target, outside / "moved")
        target.symlink_to(outside / "moved", target_is_directory=(outside / "moved").is_dir())
    elif how == "bomb":
        # A block of a kilobyte that says it has 24 MB, with its checksum, and marked.
        data = Zstd(level=1).encode(bytes(24_000_000))
        file = store / "y/c/1/0/0"
        file.write_bytes(data + crc32c(data).to_bytes(4, "little"))
        mark(store, "y", 1)
    elif how == "pipe":
        chunk.unlink()
        os.mkfifo(chunk)
    else:
        # A file with holes: long, and nearly nothing on the disk.
        with open(chunk, "r+b") as file:
            file.truncate(50_000_000)
    return how
