"""A self-contained page: HTML, the numbers that it shows, and the scripts that show them, in one file.

Numbers are stored as base64 of little-endian arrays in a JSON text, which the scripts (`web_page/*.js`) decode:
three bytes become four characters. No script loads anything from outside.
"""

import hashlib
import html
import json
import math
from base64 import b64encode
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np

WHOLE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>body {{ margin: 16px; background: #fff; font-family: system-ui, sans-serif; color: #222; }}
h1 {{ font-size: 20px; margin: 0 0 12px; }}</style>
</head>
<body>
<main>
<h1>{title}</h1>
{body}
</main>
</body>
</html>
"""


class Page:
    """An interactive page, in a notebook or in a browser from the file that `save` writes.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swept = lj.sweep(lambda point: jnp.sin(point["angle"]), {"angle": jnp.linspace(0.0, 3.0, 31)}, progress=False)
    >>> swept.to_html().title
    'Sweep over angle'

    - `title`: the heading of the saved page; `html`: the content; `words`: a description for `print`.
    """

    def __init__(self, title: str, body: str, words: str):
        self.title, self.html, self.words = title, body, words

    def save(self, path) -> None:
        """Write a page that works in any browser, without Python and without a network."""
        as_page(path).write_text(whole(self.title, self.html), encoding="utf-8")

    def _repr_html_(self):
        return self.html

    def __repr__(self):
        return (
            f'{self.words}, {in_bytes(len(self.html))}: works in a notebook, and with .save("page.html") in a browser'
        )


def as_page(path, others: str = "") -> Path:
    """The path of a page; raise for one whose name says that it is something else. `others`: what else it can be."""
    path = Path(path)
    if path.suffix.lower() not in ("", ".html", ".htm"):
        raise ValueError(
            f"this is saved as a page (HTML), and '{path.name}' would be no {path.suffix} file.\n"
            f'Fix: .save("{path.stem}.html"), which any browser shows{others.replace("{}", path.stem)}.'
        )
    return path


def whole(title: str, body: str) -> str:
    """A complete HTML document around a fragment."""
    return WHOLE.format(title=html.escape(title), body=body)


def fragment(body: str, spec: dict[str, Any], scripts: tuple[str, ...], last: str = "") -> str:
    """HTML with its numbers and scripts, for a page or a notebook's cell.

    **Arguments:** `body`: the HTML before a script runs; `spec`: the data for the scripts, as JSON; `scripts`: files in
    `web_page/`, in the order in which they build on each other; `last`: a line of script after them.
    """
    folder = files(__package__) / "web_page"
    data = json.dumps(spec, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "".join(folder.joinpath(name).read_text(encoding="utf-8") for name in scripts) + last
    # The same numbers give the same name, so a notebook that is run again does not change.
    name = "lagjax-" + hashlib.sha256((data + body).encode()).hexdigest()[:12]
    # A page may contain the fragment twice: each script takes the first one that is not yet live.
    return (
        f'<div class="lagjax" id="{name}"><style>{folder.joinpath("page.css").read_text(encoding="utf-8")}</style>\n'
        f'{body}\n<script type="application/json">{data}</script>\n<script>(() => {{\n"use strict";\n'
        f'const root = document.querySelector("#{name}:not([data-live])");\nroot.dataset.live = "";\n'
        "const unique = `${root.id}-${Math.random().toString(36).slice(2, 8)}`;\n"
        "const spec = JSON.parse(root.querySelector('script[type=\"application/json\"]').textContent);\n"
        f"{script}\n}})();</script></div>"
    )


def encoded(x, dtype: str) -> tuple[str, str]:
    """An array in the form read by `decode`: its type, "f4", "f8", "i1", "i2" or "i4", and little-endian base64."""
    return dtype, b64encode(np.ascontiguousarray(x, dtype=f"<{dtype}").tobytes()).decode()


# What a column of numbers is over lanes and frames: the same in all, at each time the same in all lanes, the same all
# the time in each lane, or none of that.
FIXED, OF_TIME, OF_LANE, FREE = "ftlv"


def encoded_once(x, dtype: str, nothing: float = np.nan) -> tuple:
    """An array (N, F, ...) over lanes and frames for `decode`, in which what is constant over either is there once.

    Most of a film stands still: pivots, rails, a circle of sixty points. Behind the numbers are the letter of each
    column (`FIXED` and so on), N, F, and the lanes without a motion, which are `nothing` throughout.
    """
    x = np.asarray(x, dtype=f"<{dtype}")
    if not x.size:
        return encoded(x, dtype)
    lanes, frames = x.shape[:2]
    columns = x.reshape(lanes, frames, -1)
    empty = np.isnan(columns) if np.isnan(nothing) else columns == nothing
    empty = empty.all(axis=(1, 2))
    if empty.all():
        return encoded(x, dtype)
    known = columns[~empty]
    of_time = np.all((known == known[:1]) | (np.isnan(known) & np.isnan(known[:1])), axis=(0, 1))
    of_lane = np.all((known == known[:, :1]) | (np.isnan(known) & np.isnan(known[:, :1])), axis=(0, 1))
    kinds = [FIXED if a and b else OF_TIME if a else OF_LANE if b else FREE for a, b in zip(of_time, of_lane)]
    parts = [np.zeros(0, x.dtype)]
    for kind in (FIXED, OF_TIME, OF_LANE, FREE):
        where = [i for i, found in enumerate(kinds) if found == kind]
        of_kind = known[:1, :, where] if kind in (FIXED, OF_TIME) else columns[:, :, where]
        parts.append((of_kind[:, :1] if kind in (FIXED, OF_LANE) else of_kind).reshape(-1))
    if len(text := encoded(np.concatenate(parts), dtype)[1]) > 0.9 * len(encoded(x, dtype)[1]):
        return encoded(x, dtype)
    return dtype, text, "".join(kinds), lanes, frames, np.flatnonzero(empty).tolist()


def in_bytes(count: float) -> str:
    """A size in kB or MB."""
    return f"{math.ceil(count / 1e3)} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"
