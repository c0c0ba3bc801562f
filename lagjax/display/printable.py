"""Text of the user's or of a file, as it may be printed: no character of it commands a terminal, or hides another."""


def printable(text: object) -> str:
    """Text with control characters, line ends among them, and characters without a width written as escapes."""
    text = str(text)
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def by_line(text: object) -> str:
    """Text of several lines, each as `printable` writes it."""
    return "\n".join(map(printable, str(text).split("\n")))


def is_plain(text: str) -> bool:
    """Whether a text has only characters that `printable` leaves as they are, line ends and tabs."""
    return text.replace("\n", "").replace("\t", "").isprintable()
