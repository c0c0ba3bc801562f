"""A page is one text: numbers are exact bit for bit, nothing is loaded from outside, and names are escaped."""

import base64
import json
import re
import shutil
import subprocess
from importlib.resources import files

import numpy as np
import pytest

from lagjax.display.page import Page, encoded, encoded_once, fragment, whole

NASTY = '</script><script>alert("1")</script><!-- & \u2028'


def told(html):
    """The data for the scripts of a page."""
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)[1])


def decoded(pair, *shape):
    """An array of the script's data, as the page puts it together."""
    found = np.frombuffer(base64.b64decode(pair[1]), f"<{pair[0]}")
    if len(pair) == 2:
        return found.reshape(shape)
    kinds, lanes, frames, empty = pair[2:]
    whole, start = np.full((lanes, frames, len(kinds)), np.nan), 0
    for kind, of_lanes, of_frames in (("f", 1, 1), ("t", 1, frames), ("l", lanes, 1), ("v", lanes, frames)):
        where = [i for i, letter in enumerate(kinds) if letter == kind]
        size = of_lanes * of_frames * len(where)
        whole[:, :, where] = found[start : start + size].reshape(of_lanes, of_frames, len(where))
        start += size
    whole[empty] = np.nan if pair[0][0] == "f" else -(2**15)
    return whole.astype(pair[0]).reshape(shape)


def test_what_is_constant_is_there_once():
    """Columns that stand still, or move alike in all lanes, take their share; so says the page's script."""
    x = np.random.default_rng(0).normal(size=(4, 50, 6))
    x[:, :, 0], x[:, :, 1], x[:, :, 4], x[2] = 3.0, x[:1, :, 1], x[:, :1, 4], np.nan
    y = np.rint(1e3 * x)
    y[2] = -(2**15)
    for given, dtype, nothing in ((x, "f4", np.nan), (y, "i2", -(2**15)), (x[:2, :, 2:4], "f8", np.nan)):
        pair = encoded_once(given, dtype, nothing)
        np.testing.assert_array_equal(decoded(pair, *given.shape), given.astype(dtype))
        if shutil.which("node"):
            script = files("lagjax.display").joinpath("web_page/decode.js").read_text(encoding="utf-8")
            ask = f"{script};console.log([...decode({json.dumps(pair)})].join())"
            told = subprocess.run(["node", "-e", ask], capture_output=True, text=True, check=True).stdout
            np.testing.assert_array_equal(np.array(told.split(","), float), given.astype(dtype).reshape(-1))
    assert encoded_once(x, "f4")[2:] == ("ftvvlv", 4, 50, [2])
    assert len(encoded_once(x, "f4")[1]) < 0.6 * len(encoded(x, "f4")[1]) and len(pair) == 2


@pytest.mark.parametrize("dtype", ["f4", "f8", "i1", "i2"])
def test_numbers_come_back(dtype):
    """Base64 contains the array, little-endian, last axis fastest, also for a transposed array."""
    x = np.arange(-6, 6).reshape(3, 4).T
    kind, text = encoded(x, dtype)
    back = np.frombuffer(base64.b64decode(text), f"<{kind}")
    np.testing.assert_array_equal(back, x.reshape(-1))
    # Twin: the other order gives a different array.
    assert not np.array_equal(back, x.T.reshape(-1))


def test_names_do_no_harm():
    """A name that looks like the end of a script stays data; numbers that JSON lacks are refused."""
    html = fragment("<p>body</p>", {"name": NASTY}, ("decode.js",))
    assert told(html) == {"name": NASTY}
    assert html.count("</script>") == 2
    with pytest.raises(ValueError):
        fragment("", {"x": float("nan")}, ())


def test_the_same_is_the_same_text():
    """The same content has the same name, so a notebook run again does not change; other content has another name."""
    one, other = (fragment("", {"x": x}, ("decode.js",)) for x in (1, 2))
    assert one == fragment("", {"x": 1}, ("decode.js",)) and one[:40] != other[:40]


def test_a_page_of_its_own(tmp_path):
    """A saved page has a language, a title and a heading, and no URL; it prints its size."""
    page = Page("A < B", "<p>body</p>", "Page of 3 points")
    page.save(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert text == whole("A < B", "<p>body</p>") and text.startswith("<!DOCTYPE html>")
    assert '<html lang="en">' in text and "<title>A &lt; B</title>" in text and "<h1>A &lt; B</h1>" in text
    assert not re.findall(r"https?://|(?:src|href)=", text)
    assert repr(page).startswith("Page of 3 points, 1 kB: works in a notebook") and page._repr_html_() == page.html
