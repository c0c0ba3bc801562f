"""`python -m lagjax`: see `lagjax/job.py`."""

import sys

from lagjax.job import main

# Parts of the job run in separate processes, which import this file as well.
if __name__ == "__main__":
    sys.exit(main())
