"""Skips tests of optimisations (written-out programs, assumed regularity, freed programs) that `LAGJAX_PLAIN=1` turns off."""

import pytest

from lagjax.jax_internals.plain import is_plain

not_plain = pytest.mark.skipif(is_plain(), reason="LAGJAX_PLAIN=1 rewrites nothing")
