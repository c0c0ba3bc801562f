"""A page that works by itself: HTML, the numbers that it shows, and the scripts that show them, in one file.

Numbers travel as base64 of little-endian arrays in a JSON text, which the scripts (`*.js` beside this file) decode:
three bytes become four characters. No script asks for anything from outside.
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
    """What plays and answers in a notebook, and in a browser from the page that `save` writes.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> swept = lj.sweep(lambda point: jnp.sin(point["angle"]), {"angle": jnp.linspace(0.0, 3.0, 31)}, progress=False)
    >>> swept.to_html().title
    'Sweep over angle'

    - `title`: what stands above it in a page of its own; `html`: itself; `words`: what it is, for `print`.
    """

    def __init__(self, title: str, body: str, words: str):
        self.title, self.html, self.words = title, body, words

    def save(self, path) -> None:
        """Write a page that works in any browser, without Python and without a network."""
        Path(path).write_text(whole(self.title, self.html), encoding="utf-8")

    def _repr_html_(self):
        return self.html

    def __repr__(self):
        return (
            f'{self.words}, {in_bytes(len(self.html))}: works in a notebook, and with .save("page.html") in a browser'
        )


def whole(title: str, body: str) -> str:
    """A document of its own around some HTML."""
    return WHOLE.format(title=html.escape(title), body=body)


def fragment(body: str, spec: dict[str, Any], scripts: tuple[str, ...], last: str = "") -> str:
    """HTML with its numbers and scripts, for a page or a notebook's cell.

    **Arguments:** `body`: what is there before a script runs; `spec`: what the scripts are told, as JSON; `scripts`:
    files beside this one, in the order in which they build on each other; `last`: a line of script after them.
    """
    beside = files(__package__)
    data = json.dumps(spec, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    script = "".join(beside.joinpath(name).read_text(encoding="utf-8") for name in scripts) + last
    # The same numbers have the same name: run again, a notebook does not change.
    name = "lagjax-" + hashlib.sha256((data + body).encode()).hexdigest()[:12]
    # The page may hold it twice: the script takes the first that no script has taken.
    return (
        f'<div class="lagjax" id="{name}"><style>{beside.joinpath("page.css").read_text(encoding="utf-8")}</style>\n'
        f'{body}\n<script type="application/json">{data}</script>\n<script>(() => {{\n"use strict";\n'
        f'const root = document.querySelector("#{name}:not([data-live])");\nroot.dataset.live = "";\n'
        "const unique = `${root.id}-${Math.random().toString(36).slice(2, 8)}`;\n"
        "const spec = JSON.parse(root.querySelector('script[type=\"application/json\"]').textContent);\n"
        f"{script}\n}})();</script></div>"
    )


def encoded(x, dtype: str) -> tuple[str, str]:
    """An array as `decode` reads it: its type, `"f4"`, `"f8"`, `"i1"` or `"i2"`, and base64 of it, little-endian."""
    return dtype, b64encode(np.ascontiguousarray(x, dtype=f"<{dtype}").tobytes()).decode()


def in_bytes(count: float) -> str:
    """A size in words."""
    return f"{math.ceil(count / 1e3)} kB" if count < 1e6 else f"{count / 1e6:.1f} MB"
