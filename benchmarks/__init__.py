"""Measurements of lagjax, in folders by what they ask; each is run as a module from the root of the repository.

    speed       run times, first answers, scaling; beside other tools
    accuracy    errors against closed forms and long-double references, orders, error estimates
    campaigns   searches for failures among random systems, events, fits, advice: for hours, weekly, not in CI
    learned     networks in L, trained and compared
    gpu         batches on a device

`house.py` gives the figures of the source, `measure.py` is shared by all, `quote.py` writes the tables of the README
from `results/`.

    python -m benchmarks.speed.first_answer --only rod
"""

import os

# First answers are those of a system that was never seen, unless the environment says otherwise.
os.environ.setdefault("LAGJAX_CACHE", "off")
