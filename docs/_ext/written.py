"""Write a generated page only if it has changed, so that a second build is short."""

from pathlib import Path


def write(path: Path, text: str) -> None:
    """Write a page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if not path.exists() or path.read_text() != text:
        path.write_text(text)


def clear(folder: Path, keep: set[str]) -> None:
    """Remove pages of an earlier build that are no longer made."""
    for path in folder.iterdir():
        if path.name not in keep:
            path.unlink()
