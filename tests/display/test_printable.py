"""Names in a terminal: control characters in them do nothing."""

import lagjax as lj
from lagjax.display.printable import by_line, printable
from lagjax.system import coordinates
from tests.behaviour.test_text_of_others import BAD


def test_in_a_terminal():
    """Control characters and those that turn the direction are escaped; others, of any alphabet, are not."""
    assert printable("a\x1b[2J\u202eb\nc") == "a\\x1b[2J\\u202eb\\nc" and by_line("a\nb\r") == "a\nb\\r"
    assert printable("θ, ё and 速度") == "θ, ё and 速度"
    assert all(name.isprintable() for name in coordinates.names({BAD: 1.0, "x": {BAD: 2.0}}))
    system = lj.System(lambda t, q, v, params: 0.5 * v**2, {BAD: lj.Holonomic(lambda t, q, params: q)})
    assert repr(system).isprintable() and "\\x1b[2J" in repr(system)
