"""The methods that are compared: defaults with their orders, and those that do not fit a motion."""

import pytest

import lagjax as lj
from tests.systems import PARAMS, rod_pendulum
from tests.work_precision.test_work_precision import TS, compared


@pytest.mark.slow
@pytest.mark.optimised
def test_default_methods_and_their_orders():
    """The default of `integrate` comes first; each method shows its order; Tsit5's is not Dopri8's; all agree."""
    found = compared()
    assert list(found.curves) == ["Nystrom12", "Dopri8", "Tsit5"]
    # The error of an oscillation's amplitude has one order more.
    for name, order in (("Tsit5", 5), ("Dopri8", 8), ("Nystrom12", 12)):
        assert order - 1 < found[name].order < order + 2.5
    assert all(point.ended_well and point.seconds > 0 for point in found.points)
    assert all(curve.compile_seconds > 0 for curve in found.curves.values()) and found.call_seconds > 0
    assert found.reference.agrees and 10 <= found.reference.digits <= 14 and "WARNING" not in repr(found)


def test_nystrom_methods_are_for_accelerations_without_velocities():
    """With constraints a Nyström method is refused."""
    start = {"x": 1.25, "y": 0.0}, {"x": 0.0, "y": 0.0}
    with pytest.raises(ValueError, match="method 'Nystrom12' is for accelerations.*there are constraints"):
        lj.work_precision(rod_pendulum, *start, PARAMS, ts=TS, methods=[lj.Nystrom12()])
