"""The line that shows how far long work has come.

Short work shows nothing, nor is anything shown where nobody looks.
"""

from contextlib import nullcontext


class Silent(nullcontext):
    """A meter that shows nothing: where tqdm is not installed."""

    disable = True

    def __init__(self):
        super().__init__(self)

    def update(self, count):
        """Nothing."""


def meter(progress: bool | None, **settings):
    """A context that takes `update(count)`; `settings` go to tqdm. `progress` None: shown where somebody looks."""
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return Silent()
    disable = None if progress is None else not progress
    return tqdm(delay=0.0 if progress else 1.0, disable=disable, **settings)
