"""The lines that show how far long work has come, and what it waits for.

Short work shows nothing, nor is anything shown where nobody looks.
"""

import threading
from contextlib import contextmanager, nullcontext

# Seconds after which what takes so long is announced, and between two looks at the clock then.
LONG, TICK = 0.5, 1.0


class Silent(nullcontext):
    """A meter that shows nothing: where tqdm is not installed."""

    disable = True

    def __init__(self):
        super().__init__(self)

    def update(self, count):
        """Nothing."""

    def refresh(self):
        """Nothing."""


def meter(progress: bool | None, **settings):
    """A context that takes `update(count)`; `settings` go to tqdm. `progress` None: shown where somebody looks."""
    try:
        from tqdm.auto import tqdm
    except ImportError:
        return Silent()
    disable = None if progress is None else not progress
    return tqdm(**{"delay": 0.0 if progress else 1.0, "disable": disable} | settings)


@contextmanager
def waiting(progress: bool | None, words: str):
    """Say in `words` what is waited for, and how long by now; until it is done, or the event that this gives is set."""
    done = threading.Event()

    def tell():
        if done.wait(LONG):
            return
        with meter(progress, desc=words, bar_format="{desc}, {elapsed}", leave=False, delay=0.0, position=0) as shown:
            while not done.wait(TICK):
                shown.refresh()

    thread = threading.Thread(target=tell, daemon=True)
    if progress is not False:
        thread.start()
    try:
        yield done
    finally:
        done.set()
        if thread.ident is not None:
            thread.join()
