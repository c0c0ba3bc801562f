"""A file's path, or its text: which of both was given."""

from pathlib import Path


def file_of(source: str | Path, user: str) -> Path | None:
    """The path of an existing file, None where the text itself was given; `user` is the function that asks."""
    if isinstance(source, str) and source.strip().startswith("<"):
        return None
    if not isinstance(source, (str, Path)):
        raise TypeError(f"{user} takes the path of a file or its text, not {type(source).__name__}.")
    path = Path(source).expanduser()
    if not path.is_file():
        raise FileNotFoundError(
            f"there is no file '{source}', seen from {Path.cwd()}.\nUsual cause: another working directory, or a "
            f'package:// name, which ROS alone knows.\nFix: {user}("/path/to/the/file"), or the text itself.'
        )
    return path
