"""Does the advice help? Each fix that a message of a failed or inaccurate motion proposes is applied as it says.

Every case fails, or warns, in its own way; the message must contain the words of its cause, the fix is read off the
message where it holds numbers, and the error of the motion after it is compared with a closed form, or with a motion
at a far tighter tolerance. `inf` before: there is no result at all. The exit status is 1 if a target is missed.

    python -m benchmarks.campaigns.advice [--json FILE] [--only TEXT]
"""

import re
import sys
import warnings
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy.special import ellipj, ellipk

import lagjax as lj
from benchmarks.measure import main, row

jax.config.update("jax_enable_x64", True)


class Case(NamedTuple):
    """A motion and what is said of it.

    `run(**options)` -> its last output; `options`: those with which it goes wrong; `words`: what the message must say;
    `fix(message)` -> (what is applied, the last output after it); `exact`: the right one; `allowed`: the error after.
    """

    run: Callable
    options: dict
    words: str
    fix: Callable
    exact: float
    allowed: float = 1e-6


def force(function, dissipation=None):
    """A particle on a line under a force."""
    return lj.System(lambda t, q, v, p: 0.5 * v**2, force=function, dissipation=dissipation)


def number(pattern, message):
    """The first number in a message after a pattern."""
    return float(re.search(pattern + r"([-+.\de]*\d)", message)[1])


pendulum = lj.System(lambda t, q, v, p: 0.5 * v**2 + 9.81 * jnp.cos(q))
spring = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2)
damped = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * q**2, dissipation=lambda t, q, v, p: 0.5e4 * v**2)
# A block that a belt of velocity 0.5 brakes with 2.
belt = force(lambda t, q, v, p: -2 * jnp.sign(v - 0.5))
switched = force(lambda t, q, v, p: jnp.sign(jnp.sin(50 * t)))
cycloid = lj.System(lambda y, x, u, p: jnp.sqrt((1 + u**2) / (2 * 9.81 * y)))
hole = lj.System(lambda t, q, v, p: 0.5 * (-(1 - 2 / q["r"]) * v["t"] ** 2 + v["r"] ** 2 / (1 - 2 / q["r"])))
ball = lj.System(lambda t, q, v, p: 0.5 * v**2 - 10.0 * q)
pulse = force(lambda t, q, v, p: jnp.where((t > 4.0) & (t < 4.1), 1.0, 0.0))
planet = lj.System(lambda t, q, v, p: 0.5 * v @ v + 1 / jnp.sqrt(q @ q))
on_floor = {"floor": lj.Holonomic(lambda t, q, p: q)}
lying = lj.System(lambda t, q, v, p: 0.5 * v**2 - 10.0 * q, on_floor)


def last(system, q0, v0, ts, **options):
    """The first coordinate at the last output."""
    traj = lj.integrate(system, q0, v0, ts=ts, **options)
    return float(np.ravel(jax.tree.leaves(traj.q)[0][-1])[0])


def of_pendulum(span, **options):
    """The pendulum's last angle."""
    return last(pendulum, 1.0, 0.0, np.array([0.0, span]), **options)


def swing(t):
    """The exact angle of the pendulum from rest at 1, at g/l = 9.81."""
    m = np.sin(0.5) ** 2
    sn = ellipj(ellipk(m) - np.sqrt(9.81) * t, m)[0]
    return 2 * np.arcsin(np.sin(0.5) * sn)


def depth(y, u0=0.0075, y0=1e-4):
    """x of the cycloid from y0 on: x' = √(y / (d - y)), with d = y0 (1 + 1/u0²)."""
    d = y0 * (1 + 1 / u0**2)
    primitive = lambda y: d * np.arcsin(np.sqrt(y / d)) - np.sqrt(y * (d - y))
    return primitive(y) - primitive(y0)


def proper_radius(tau):
    """r after a fall from r = 6 with E = 1 at M = 1: r^(3/2) = 6^(3/2) - 3 τ/√2."""
    return (6**1.5 - 3 * tau / np.sqrt(2)) ** (2 / 3)


def sum_of_switched(t):
    """Position after t under a force of one whose sign changes every π/50, from rest."""
    edges = np.append(np.arange(0, t, np.pi / 50), t)
    q = v = 0.0
    for i, h in enumerate(np.diff(edges)):
        a = (-1) ** i
        q, v = q + h * v + 0.5 * a * h * h, v + a * h
    return q


def bouncing(rest=None):
    """A ball whose bounces halve its speed."""
    touch = lj.guards.touches(lambda t, q, p: q, restitution=0.5)
    switch = lj.Switch("flying", to="flying", when=touch, rest=rest, **({} if rest is None else {"slower_than": 1e-8}))
    return lj.Hybrid({"flying": ball} | ({"lying": lying} if rest else {}), [switch], most_switches=60)


def row_of_balls(most=16):
    """Three balls of diameter 0.2 that collide without restitution: the first hits two that touch."""
    balls = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2))
    gaps = [lj.guards.touches(lambda t, q, p, i=i: q[i + 1] - q[i] - 0.2, restitution=0.0) for i in range(2)]
    return lj.Hybrid({"fly": balls}, [lj.Switch("fly", to="fly", when=gap) for gap in gaps], most_switches=most)


def of_row(most=16, **options):
    """The first ball's last place."""
    return last(row_of_balls(most), np.array([-0.3, 0.1, 0.3]), np.array([1.0, 0, 0]), np.array([0, 1.2]), **options)


# Jumps are found by default, and then neither of these motions stops early.
IGNORED = {"max_steps": 500, "jumps": "ignored"}
CASES = {
    "max_steps used up over many periods: max_steps": Case(
        lambda **o: of_pendulum(100.0, **o), {"max_steps": 150}, "an oscillation of period",
        lambda m: (f := int(number("max_steps=", m)), of_pendulum(100.0, max_steps=f)), swing(100.0)),
    "a force that jumps in time: jumps that are found": Case(
        lambda **o: last(switched, 0.0, 0.0, np.array([0.0, 10.0]), **o), IGNORED,
        '(?s)with t in the force.*jumps="found"',
        lambda m: ('jumps="found"', last(switched, 0.0, 0.0, np.array([0.0, 10.0]))), sum_of_switched(10.0), 1e-9),
    "a stiff system: Radau5": Case(
        lambda **o: last(damped, 1.0, 0.0, np.array([0.0, 1e3]), **o), {"max_steps": 500}, "a stiff system",
        lambda m: ("method=lj.Radau5()", last(damped, 1.0, 0.0, np.array([0.0, 1e3]), max_steps=500,
                                              method=lj.Radau5())), np.exp(-1e3 / 1e4), 1e-6),
    "a slope that becomes infinite: ts that end before": Case(
        lambda **o: last(cycloid, 0.0, 0.0075, np.array([1e-4, 1.9]), **o), {"max_steps": 3000},
        "velocity of 'q' grows without bound as t -> 1.7778",
        lambda m: (f := 0.999 * number("ts that end before ", m),
                   last(cycloid, 0.0, 0.0075, np.array([1e-4, f])) - depth(f)), 0.0),
    "a horizon: the event": Case(
        lambda **o: last(hole, {"t": 0.0, "r": 6.0}, {"t": 1.5, "r": -((1 / 3) ** 0.5)}, np.array([0.0, 6.0]), **o),
        {"max_steps": 3000}, "velocity of 't' grows without bound as t -> 5.5948",
        lambda m: ("the event", at_horizon(m)), 0.0),
    "dry friction that holds: jumps that are found": Case(
        lambda **o: last(belt, 0.0, 1.0, np.array([0.0, 10.0]), **o), IGNORED,
        '(?s)with sign of v in the force.*jumps="found"',
        lambda m: ('jumps="found"', last(belt, 0.0, 1.0, np.array([0.0, 10.0]))), 0.1875 + 9.75 * 0.5),
    "bounces that accumulate: a phase of rest": Case(
        lambda **o: last(bouncing(), 5.0, 0.0, np.array([0.0, 3.5]), **o), {}, "each takes 0.5 of",
        lambda m: ('rest="lying"', last(bouncing("lying"), 5.0, 0.0, np.array([0.0, 3.5]))), 0.0),
    "impacts at one instant: most_switches": Case(
        of_row, {}, "still change velocities",
        lambda m: (f := int(number("most_switches=", m)), of_row(f)), -0.1 + 1 / 3),
    "fixed steps that are too long: adaptive ones": Case(
        lambda **o: of_pendulum(20.0, **o),
        {"stepsize_controller": diffrax.ConstantStepSize(), "dt0": 0.4, "method": diffrax.Tsit5()},
        "half as long they change the result by",
        lambda m: ("leave stepsize_controller out", of_pendulum(20.0)), swing(20.0)),
    "a loose tolerance: a tighter rtol": Case(
        lambda **o: of_pendulum(100.0, **o), {"rtol": 1e-3}, "errors of .* steps add up|amplifies errors",
        lambda m: (f := number("rtol=", m), of_pendulum(100.0, rtol=f)), swing(100.0), 5e-3),
    "a force between the steps: max_step": Case(
        lambda **o: last(pulse, 0.0, 0.0, np.array([0.0, 10.0]), **o), {"jumps": "ignored"}, "narrower than the steps",
        lambda m: ("max_step=0.05", last(pulse, 0.0, 0.0, np.array([0.0, 10.0]), jumps="ignored", max_step=0.05)),
        0.595),
    "close encounters with a centre: a tighter rtol": Case(
        lambda **o: of_planet(**o), {"rtol": 1e-6}, "near a singularity: .* digits were lost",
        lambda m: (f := number("rtol=", m), of_planet(rtol=f)), 0.01),
    "a start off a constraint: the nearest on it": Case(
        lambda **o: last(lying, 0.1, 0.0, np.array([0.0, 1.0]), **o), {}, "off the constraints: 'floor' = 0.1",
        lambda m: ("lj.consistent_state",
                   last(lying, *lj.consistent_state(lying, 0.0, 0.1, 0.0, None), np.array([0.0, 1.0]))), 0.0),
    "an infinite tolerance: fixed steps": Case(
        lambda **o: last(spring, 1.0, 0.0, np.array([0.0, 1.0]), **o), {"rtol": np.inf}, "rtol is infinite",
        lambda m: (f := number("dt0=", m), last(spring, 1.0, 0.0, np.array([0.0, 1.0]), dt0=f,
                                                stepsize_controller=diffrax.ConstantStepSize())), np.cos(1.0)),
    "times that cannot be told apart: time from the start": Case(
        lambda **o: last(spring, 1.0, 0.0, np.array([1e16, 1e16 + 2]), **o), {}, "no room for steps",
        lambda m: ("ts - ts[0]", last(spring, 1.0, 0.0, np.array([0.0, 2.0]))), np.cos(2.0)),
}  # fmt: skip


def of_planet(**options):
    """The first coordinate after twenty turns of eccentricity 0.99, which begin and end at the pericentre, 0.01."""
    start = np.array([0.01, 0.0]), np.array([0.0, np.sqrt(1.99 / 0.01)])
    return last(planet, *start, np.linspace(0.0, 40 * np.pi, 201), **options)


def at_horizon(message):
    """How far r is from its closed form where the advised event ends the motion."""
    bound = number(r"lj.Crossing\(lambda t, q, v, params: ", message)
    near = lj.Crossing(lambda t, q, v, params: bound - jnp.abs(v["t"]))
    start = {"t": 0.0, "r": 6.0}, {"t": 1.5, "r": -((1 / 3) ** 0.5)}
    end = lj.integrate(hole, *start, ts=np.array([0.0, 6.0]), events={"near": near}).end
    return float(end.q["r"]) - proper_radius(float(end.t))


def before(case):
    """The message, and the error with which the motion goes wrong; infinite if it fails."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        try:
            found = case.run(**case.options)
        except (RuntimeError, ValueError) as error:
            return str(error), np.inf
    return "\n".join(str(x.message) for x in told), abs(found - case.exact)


def rows(wanted, missing):
    """The error after each fix; before, and what was applied, beside it."""
    for name, case in CASES.items():
        if not wanted(name):
            continue
        message, wrong = before(case)
        if not re.search(case.words, message):
            line = row(name, np.inf, case.allowed, said=message.replace("\n", " ")[:200] or "nothing")
        else:
            try:
                applied, right = case.fix(message)
                line = row(name, abs(right - case.exact), case.allowed, before=wrong, applied=applied)
            except (RuntimeError, ValueError, TypeError) as error:
                line = row(name, np.inf, case.allowed, before=wrong, failed=str(error).replace("\n", " ")[:200])
        missing.extend([] if line["met"] else [line])
        yield line


if __name__ == "__main__":
    missing = []
    main(lambda wanted: rows(wanted, missing), __doc__)
    sys.exit(bool(missing))
