"""A page is one text: numbers are exact bit for bit, nothing is loaded from outside, and names are escaped."""

import base64
import json
import re

import numpy as np
import pytest

from lagjax.display.page import Page, encoded, fragment, whole

NASTY = '</script><script>alert("1")</script><!-- & \u2028'


def told(html):
    """The data for the scripts of a page."""
    return json.loads(re.search(r'<script type="application/json">(.*?)</script>', html, re.DOTALL)[1])


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
