"""Where the search begins: answers that only a fan of motions finds, against closed forms."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

import lagjax as lj

kepler = lj.System(lambda t, q, v, params: 0.5 * (v[0] ** 2 + q[0] ** 2 * v[1] ** 2) + 1 / q[0])


def lambert(a, b, turns):
    """The time over the universal variable z, and the start velocity, of orbits with so many revolutions before b.

    Curtis, *Orbital Mechanics*, §5.3, with z beyond (2π turns)²."""
    r_a, r_b = np.linalg.norm(a), np.linalg.norm(b)
    angle = np.arctan2(a[0] * b[1] - a[1] * b[0], a @ b) % (2 * np.pi)
    reach = np.sin(angle) * np.sqrt(r_a * r_b / (1 - np.cos(angle)))

    def y(z):
        return r_a + r_b - reach * np.sin(np.sqrt(z)) / np.sqrt(1 - np.cos(np.sqrt(z)))

    def time(z):
        root = np.sqrt(z)
        third = (root - np.sin(root)) / z**1.5
        return (y(z) * z / (1 - np.cos(root))) ** 1.5 * third + reach * np.sqrt(y(z))

    def velocity(z):
        return (b - (1 - y(z) / r_a) * a) / (reach * np.sqrt(y(z)))

    return time, velocity, angle


@pytest.mark.exhaustive
def test_lambert_with_revolutions():
    """Kepler's problem with given ends and time, one and two revolutions between: both orbits of each of four cases to
    1e-11, from launches at several speeds and directions. Twin: another time has other orbits."""
    a, count = np.array([1.0, 0.0]), 0
    for b in (np.array([-0.3, 1.2]), np.array([-0.9, -1.0])):
        for turns in (1, 2):
            time, velocity, angle = lambert(a, b, turns)
            low, high = (2 * np.pi * turns) ** 2 * (1 + 1e-5), (2 * np.pi * (turns + 1)) ** 2 * (1 - 1e-5)
            fastest: Any = minimize_scalar(time, bounds=(low, high), method="bounded")
            whole, end = 1.3 * fastest.fun, angle + 2 * np.pi * turns
            mean, launches = (whole / end) ** (2 / 3), []
            for axis in np.array([0.85, 1.0, 1.12, 1.25]) * mean:
                for steep in np.deg2rad([-40.0, -20.0, 20.0, 40.0]):
                    v = np.sqrt(2 - 1 / axis) * np.array([np.sin(steep), np.cos(steep)])
                    ts = np.linspace(0.0, whole, 100)
                    launches.append(lj.integrate(kepler, np.array([1.0, 0.0]), v, ts=ts, estimate_error=False))
            q_b = np.array([np.linalg.norm(b), end])
            found = lj.connect(kepler, np.array([1.0, 0.0]), q_b, 0.0, whole, starts=launches, elements=24, outputs=2)
            # At a distance of one, both components are velocities.
            starts = np.array([answer.start_velocity for answer in (found, *found.others)])
            for bracket in ((low, fastest.x), (fastest.x, high)):
                for longer, near in ((0.0, True), (1e-6, False)):
                    z = float(np.asarray(brentq(lambda z: time(z) - whole - longer, *bracket, xtol=1e-14, rtol=1e-15)))
                    assert (np.min(np.max(np.abs(starts - velocity(z)), axis=1)) < 1e-11) == near
                    count += near
    assert count == 8


@pytest.mark.exhaustive
def test_both_catenaries():
    """The surface of a soap film between two rings is a length, y² |dq|²: the upper catenary is a minimum, the lower
    one, which steeper launches find, a saddle of index 1. Twin: the straight line finds the upper one alone."""
    far, film = 0.5, lj.System(lambda t, q, v, params: 0.5 * q[1] ** 2 * (v @ v))
    a, b = np.array([-far, 1.0]), np.array([far, 1.0])
    launches = [
        lj.integrate(film, a, np.array([np.cos(steep), -np.sin(steep)]), ts=np.linspace(0, 1, 40), estimate_error=False)
        for steep in np.deg2rad([0.0, 60.0, 75.0])
    ]
    found = lj.geodesic(film, a, b, starts=launches, outputs=2)
    assert len(found.others) == 1
    for answer, bracket, kind in zip(
        (found, *found.others), ((0.5, 2.0), (0.1, 0.4)), ("minimum", "saddle of index 1"), strict=True
    ):
        neck = float(np.asarray(brentq(lambda neck: neck * np.cosh(far / neck) - 1, *bracket, xtol=1e-15)))
        area = neck * far + neck**2 / 2 * np.sinh(2 * far / neck)
        assert abs(answer.length - area) < 1e-12 and answer.kind == kind
        assert np.max(np.abs(answer.start_direction - np.array([neck, -np.sqrt(1 - neck**2)]))) < 1e-11
    straight = lj.geodesic(film, a, b, outputs=2)
    assert straight.others == () and abs(straight.length - found.length) < 1e-12
