"""What a user sees of the folder of compiled programs (`jaxtools/kept.py`)."""

from pathlib import Path

from lagjax.display import labelled
from lagjax.jaxtools import LATER, TALLY, folder

# So many reasons why programs were not kept are printed.
REASONS = 5


class Cache:
    """The folder of compiled programs, as it is now; it prints itself.

    - `path`: where it is; None if it is not used, and `why_not` then says why.
    - `programs`: how many there are, and `size`: how many bytes they take.
    - `found`, `written`: how many this process took from it, and put into it.
    - `not_kept`: why others of this process were not kept, by how many.
    """

    def __init__(self):
        LATER.wait()
        self.path: Path | None
        self.path, self.why_not = folder.place()
        self.programs, self.size = (0, 0) if self.path is None else folder.size(self.path)
        self.found, self.written = TALLY.found["found"], TALLY.found["written"]
        self.not_kept = {} if self.path is None else dict(TALLY.not_kept)

    def clear(self) -> None:
        """Drop all programs in the folder; nothing else in it is touched."""
        if self.path is not None:
            LATER.wait()
            folder.clear(self.path)
            self.programs, self.size = folder.size(self.path)

    def __repr__(self):
        rows = [("where", self.path or f"off: {self.why_not}")]
        if self.path is not None:
            words = f"{self.programs} programs, {self.size / 1e6:.1f} MB of at most {folder.MOST / 1e6:.0f}"
            rows.append(("holds", words))
        rows.append(("this process", f"found {self.found}, wrote {self.written}"))
        most = sorted(self.not_kept.items(), key=lambda item: -item[1])
        rows += [("not kept", f"{count}: {why}") for why, count in most[:REASONS]]
        return labelled("Compiled programs", rows)


def cache() -> Cache:
    """Return the folder of compiled programs: where it is, how large, how often it helped; `.clear()` empties it.

    >>> import lagjax as lj
    >>> lj.cache()
    Compiled programs
      where         off: LAGJAX_CACHE=off
      this process  found 0, wrote 0

    A motion that was compiled once, in whatever process, is there again without tracing or compiling, for the same
    meaning of your functions, shapes, settings, versions and processor. `LAGJAX_CACHE=off` in the environment turns
    the folder off, `LAGJAX_CACHE=path` names another one. It holds machine code: what may write into it can run
    anything in your name, so a folder that others may write is not used.

    **Returns:** a `Cache`, with `path`, `why_not`, `programs`, `size`, `found`, `written` and `not_kept`.

    **Raises:** nothing.
    """
    return Cache()
