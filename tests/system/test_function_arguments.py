"""Which arguments a function takes: the state, or the multipliers as well."""

from functools import partial

import pytest

from lagjax.system.traced import OF_POSITION, OF_STATE, WITH_MULTIPLIERS, takes_of


class Declared:
    """A function that says what it takes."""

    takes = OF_POSITION

    def __call__(self, *args):
        return args


def of_state(t, q, v, params):
    """The state by name."""


def with_multipliers(t, q, v, multipliers, params):
    """The multipliers as well."""


@pytest.mark.parametrize(
    ("function", "takes"),
    [
        (of_state, OF_STATE),
        (with_multipliers, WITH_MULTIPLIERS),
        (lambda time, x, u, p: 0.0, OF_STATE),
        (lambda time, x, u, pushes, p: 0.0, WITH_MULTIPLIERS),
        # What takes the state alone is called with it, however many more it would take.
        (lambda *state: 0.0, OF_STATE),
        (lambda t, q, v, params, scale=1.0: 0.0, OF_STATE),
        (partial(with_multipliers, 0.0), OF_STATE),
        (Declared(), OF_POSITION),
        (max, OF_STATE),
        (lambda t: t, OF_STATE),
    ],
    ids=["state", "multipliers", "other names", "other names, multipliers", "any number", "a default", "partial",
         "declared", "no signature", "too few"],
)  # fmt: skip
def test_by_signature(function, takes):
    """The signature decides, whatever the names, unless the function declares what it takes."""
    assert takes_of(function) == takes
