"""Times of calls: taken in turn, by their median, without the overhead of a call."""

import time

from lagjax.work_precision.programs import RESOLVED, VERY_LONG, interleaved_times, seconds_of, without_overhead


def test_a_call_takes_its_time():
    """A pause of 0.2 s is measured as at least that; twin: a call that does nothing is shorter."""
    assert seconds_of(lambda: time.sleep(0.2)) >= 0.2 > seconds_of(lambda: None)


def test_calls_are_made_in_turn():
    """One after the other, as often as asked; a very long one is not called again, and keeps its first time."""
    made = []
    calls = [lambda name=name: made.append(name) for name in "abc"]
    times = interleaved_times(calls, [0.0, 0.0, 2 * VERY_LONG], 4)
    assert "c" not in made and made.count("a") == made.count("b") >= 4
    assert "".join(made).replace("aa", "a").replace("bb", "b") == "ab" * 4
    assert times[2] == (2 * VERY_LONG, 2 * VERY_LONG)
    assert all(0 <= x.least <= x.median for x in times)


def test_the_overhead_is_subtracted():
    """What is left is the solve; a solve that disappears in the overhead counts as the least that is resolved."""
    assert without_overhead(3.0, 1.0) == 2.0
    assert without_overhead(1.0, 1.0) == without_overhead(0.5, 1.0) == RESOLVED
