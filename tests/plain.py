"""Skips tests of written-out programs, assumed regularity and freed programs if `LAGJAX_PLAIN=1` turns these off."""

import pytest

from lagjax.jaxtools.tracing import is_plain

not_plain = pytest.mark.skipif(is_plain(), reason="LAGJAX_PLAIN=1 rewrites nothing")
