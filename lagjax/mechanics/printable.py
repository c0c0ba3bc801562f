"""Text of the user's or of a file, as it may be printed: no character of it commands a terminal, or hides another."""


def printable(text: object) -> str:
    """Text with control characters, line ends among them, and characters without a width written as escapes."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in str(text))


def by_line(text: object) -> str:
    """Text of several lines, each as `printable` writes it, and not longer than a screen."""
    return "\n".join(map(printable, str(text)[:2000].split("\n")))
