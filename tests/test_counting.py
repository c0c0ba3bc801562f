"""What tests cost: the budget of the fast tier can be exceeded, and what is told of it."""

import pytest

from tests.counting import BUDGET, Cost, dearest, over_budget, told

# Just inside of each bound.
(PROGRAMS, _), (KERNELS, _), (MEMORY, _) = BUDGET
WITHIN = {"a": Cost(3.0, PROGRAMS - 1, 2.0, 0, 0.0), "b": Cost(5.0, 1, 1.0, KERNELS, 1.0)}
TWO = [(9.0, MEMORY), (8.0, 1.0)]


@pytest.mark.parametrize(
    ("more", "processes", "named"),
    [
        (Cost(), TWO, ""),
        (Cost(programs=1), TWO, f"{PROGRAMS + 1} programs"),
        (Cost(kernels=1), TWO, f"{KERNELS + 1} kernels"),
        (Cost(), [(9.0, MEMORY + 0.01), (8.0, 1.0)], "GB in a worker"),
    ],
)
def test_the_budget(more, processes, named):
    """All at their bounds is enough; one program, one kernel or some memory more is too much, by name."""
    said = over_budget(WITHIN | {"c": more}, processes)
    assert named in said and bool(said) == bool(named)


def test_what_is_told():
    """The sums of all tests, the most of all processes; of the dearest the first."""
    text = told(WITHIN, TWO)
    assert f"{PROGRAMS} programs (3 s of XLA), {KERNELS} kernels (1 s); 8 processor s" in text and "9 s" in text
    assert dearest(WITHIN, 1).endswith("  b") and "\n" not in dearest(WITHIN, 1)
