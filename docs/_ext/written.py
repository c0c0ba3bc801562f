"""Writing a generated page only where it has changed, so that a second build is a short one."""

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
