"""`python -m lagjax`: see `lagjax/job.py`."""

import sys

from lagjax.job import main

# Its parts run in processes of their own, which import this file, too.
if __name__ == "__main__":
    sys.exit(main())
