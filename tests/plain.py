"""For tests of what is written out, taken for regular or forgotten: with `LAGJAX_PLAIN=1` none of it is done."""

import pytest

from lagjax.jax_internals.plain import is_plain

not_plain = pytest.mark.skipif(is_plain(), reason="LAGJAX_PLAIN=1 rewrites nothing")
