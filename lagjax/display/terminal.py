"""What a terminal shows: progress of long work, and text that cannot command it or hide other text.

Short work shows nothing, and nothing is shown outside of terminals and notebooks.
"""

import threading
from collections.abc import Iterable, Sequence
from contextlib import contextmanager, nullcontext


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


def labelled(title: str, rows: Iterable[tuple[str, object]]) -> str:
    """What a result prints: a title, and below it values in one column, each after its label."""
    rows = list(rows)
    width = max((len(label) for label, _ in rows), default=0)
    return "\n".join(map(printable, [title, *(f"  {label:<{width}}  {value}".rstrip() for label, value in rows)]))


def columns(rows: Sequence[Sequence[str]], sides: str) -> list[str]:
    """Lines whose cells stand below each other; `sides` is "<" or ">" for each column, the last one for all further."""
    sides = sides + sides[-1] * (max(map(len, rows), default=0) - len(sides))
    widths = [max(len(row[i]) for row in rows if i < len(row)) for i in range(len(sides))]
    return ["  ".join(f"{cell:{s}{w}}" for cell, s, w in zip(row, sides, widths)).rstrip() for row in rows]


def table(header: Sequence[str], rows: Sequence[Sequence[str]], prose: bool = False) -> str:
    """A header, a line, and rows: the first column to the left, the others to the right but for a last one of prose."""
    sides = "<" + ">" * (len(header) - 2) + ("<" if prose else ">") if len(header) > 1 else "<"
    head, *shown = columns([header, *rows], sides)
    return "\n".join([head, "-" * max(map(len, [head, *shown])), *shown])


# Seconds of waiting before a message is shown, and between two updates of it.
LONG, TICK = 0.5, 1.0


class Silent(nullcontext):
    """A meter that shows nothing, used if tqdm is not installed."""

    disable = True

    def __init__(self):
        super().__init__(self)

    def update(self, count):
        """Do nothing."""

    def refresh(self):
        """Do nothing."""


def meter(progress: bool | None, **settings):
    """A context with `update(count)`; `settings` go to tqdm. `progress` None: shown in terminals and notebooks."""
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return Silent()
    disable = None if progress is None else not progress
    return tqdm(**{"delay": 0.0 if progress else 1.0, "disable": disable} | settings)


@contextmanager
def waiting(progress: bool | None, words: str):
    """Show `words` and the time waited so far, until the context ends or the event that it yields is set."""
    done = threading.Event()

    def show():
        if done.wait(LONG):
            return
        with meter(progress, desc=words, bar_format="{desc}, {elapsed}", leave=False, delay=0.0, position=0) as shown:
            while not done.wait(TICK):
                shown.refresh()

    thread = threading.Thread(target=show, daemon=True)
    if progress is not False:
        thread.start()
    try:
        yield done
    finally:
        done.set()
        if thread.ident is not None:
            thread.join()
