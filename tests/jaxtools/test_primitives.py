"""Operands of primitives of our own."""

import numpy as np

from lagjax.jaxtools.primitives import front, split


def test_operands():
    """The last ones are directions; the axis of a batch comes first, and it is known which operands have one."""
    assert split((1, 2, 3), 1) == ((1, 2), (3,)) and split((1, 2), 0) == ((1, 2), ())
    moved, batched, lanes = front([np.ones((3, 5)), np.ones(3)], [1, None])
    assert [x.shape for x in moved] == [(5, 3), (3,)] and batched == (True, False) and lanes == 5
