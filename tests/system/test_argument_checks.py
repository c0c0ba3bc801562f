"""Every public function raises the same error for anything but a system, before anything is traced."""

import inspect
import re

import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.systems import PARAMS, pendulum, rod, rod_pendulum

TS = np.linspace(0.0, 1.0, 30)
TURN = lj.Generator(lambda t, q, params: 1.0)
RECORD = lj.Record(TS, q=np.cos(TS))


def of_states(name):
    """A function of one state."""
    return lambda system: getattr(lj, name)(system, 0.0, 1.0, 0.0, PARAMS)


OF_STATES = (
    *("momentum", "mass_matrix", "accelerations", "jacobi_integral", "constraint_force", "constraint_residual"),
    *("consistent_state", "linearise", "normal_modes"),
)
# Each with whether it also takes a motion in phases.
DOORS = {name: (of_states(name), False) for name in OF_STATES} | {
    "inverse_dynamics": (lambda system: lj.inverse_dynamics(system, 0.0, 1.0, 0.0, 0.0, PARAMS), False),
    "explain": (of_states("explain"), True),
    "draw": (lambda system: lj.draw(system, 1.0, PARAMS), True),
    "integrate": (lambda system: lj.integrate(system, 1.0, 0.0, PARAMS, ts=TS), True),
    "step": (lambda system: lj.step(system, 0.0, 1.0, 0.0, PARAMS, 0.1), False),
    "rollout": (lambda system: lj.rollout(system, 1.0, 0.0, PARAMS, 10, 0.1), False),
    "connect": (lambda system: lj.connect(system, 1.0, 0.0, 0.0, 1.0, PARAMS), True),
    "steer": (lambda s: lj.steer(s, {"u": 0.0}, (0.0, 0.0), (1.0, 0.0), None, PARAMS, t_b=(0.1, 1.0)), False),
    "lqr": (lambda system: lj.lqr(system, {"u": 0.0}, (0.0, 0.0), lambda t, q, v, u, p: q**2, PARAMS), False),
    "poincare": (lambda s: lj.poincare(s, 1.0, 0.0, PARAMS, section=lambda t, q, v, params: q, ts=TS), True),
    "noether_charge": (lambda system: lj.noether_charge(system, TURN), False),
    "is_symmetry": (lambda system: lj.is_symmetry(system, TURN, 1.0, 0.0, PARAMS), False),
    "symmetries": (lambda system: lj.symmetries(system, 1.0, 0.0, PARAMS), False),
    "hamiltonian": (lambda system: lj.hamiltonian(system), False),
    "routhian": (lambda system: lj.routhian(system, "angle"), False),
    "action": (lambda system: lj.action(system, lambda t: t, PARAMS, 0.0, 1.0), False),
    "latex": (lambda system: lj.latex(system, 1.0, 0.0, PARAMS), False),
    "equilibria": (lambda system: lj.equilibria(system, PARAMS, starts=[1.0]), False),
    "continue_equilibria": (lambda system: lj.continue_equilibria(system, PARAMS, 1.0, along="g", to=3.0), False),
    "periodic_orbit": (lambda system: lj.periodic_orbit(system, (1.0, 0.0), 2.0, PARAMS), True),
    "lyapunov_exponents": (lambda system: lj.lyapunov_exponents(system, 1.0, 0.0, PARAMS, ts=TS), True),
    "work_precision": (lambda system: lj.work_precision(system, 1.0, 0.0, PARAMS, ts=TS), False),
    "horizons": (lambda system: lj.horizons(system, 1.0, 0.0, PARAMS, period=2.0), False),
    "fit": (lambda system: lj.fit(system, RECORD, PARAMS), True),
    "fit_residuals": (lambda system: lj.fit_residuals(system, RECORD, PARAMS), True),
    "fit_loss": (lambda system: lj.fit_loss(system, RECORD, PARAMS), True),
    "identifiability": (lambda system: lj.identifiability(system, RECORD, PARAMS), True),
}  # fmt: skip
NO_SYSTEMS = {
    "the Lagrangian": (pendulum.lagrangian, "the function 'pendulum_lagrangian'", r"lj.System\(pendulum_lagrangian\)"),
    "a Lagrangian without a name": (lambda t, q, v, params: v**2, "a function", r"lj.System\(lagrangian\)"),
    "the class": (lj.System, "the class System", r"lj.System\(lagrangian\)"),
    "a constraint": (lj.Holonomic(rod), "a Holonomic", "constraints={"),
    "what was found of one": (lj.noether_charge(pendulum, TURN), "a NoetherCharge", "its .system"),
    "a number": (3.0, "3.0", "as the first argument"),
    "nothing": (None, "None", "as the first argument"),
}


@pytest.mark.parametrize("door", DOORS)
def test_every_door_asks_for_a_system(door):
    """Each function of a system raises for the Lagrangian itself, a number, the class, and so on."""
    act, phases = DOORS[door]
    for given, what, fix in NO_SYSTEMS.values():
        with pytest.raises(TypeError, match=f"first argument must be a lj.System, not {what}") as caught:
            act(given)
        assert re.search(f"Usual cause: .*\nFix: .*{fix}", str(caught.value)), str(caught.value)
    if not phases:
        with pytest.raises(TypeError, match=r"takes one system.*\n.*hybrid.systems\[0\]"):
            act(lj.Hybrid({"swinging": pendulum}))


def test_no_door_is_left_out():
    """All public functions whose first argument is called `system` are tested, but one with a message of its own."""
    parts = (lj, lj.bodies, lj.guards, lj.shapes)
    public = {name: getattr(part, name) for part in parts for name in part.__all__}
    functions = {name: found for name, found in public.items() if inspect.isfunction(found)}
    first = {name: next(iter(inspect.signature(function).parameters), "") for name, function in functions.items()}
    of_systems = {name for name, argument in first.items() if argument == "system"}
    assert of_systems - {"floquet"} <= set(DOORS)
    with pytest.raises(TypeError, match=r"or a periodic orbit, not the function 'pendulum_lagrangian'.\nFix: "):
        lj.floquet(pendulum.lagrangian, 0.0, 1.0, 0.0, PARAMS, 1.0)


def test_other_refusals_of_what_is_no_system():
    """`energy_ledger` needs a motion, `sweep` a function and `Hybrid` systems as phases."""
    for act, words in (
        (lambda: lj.energy_ledger(pendulum), "needs a motion that was computed"),
        (lambda: lj.sweep(pendulum, {"g": [1.0, 2.0]}), "a function of a point"),
        (lambda: lj.Hybrid({"swinging": pendulum.lagrangian}), "phase 'swinging' must be a lj.System"),
    ):
        with pytest.raises(TypeError, match=words + "(?s:.*)Fix: "):
            act()


def test_a_system_in_another_place():
    """A system among the later arguments: the error says where it is, and gives the order."""
    for act, place in (
        (lambda: lj.integrate(1.0, 0.0, PARAMS, pendulum, ts=TS), 4),
        (lambda: lj.accelerations(0.0, 1.0, 0.0, PARAMS, rod_pendulum), 5),
        (lambda: lj.equilibria(PARAMS, pendulum, starts=[1.0]), 2),
        (lambda: lj.fit(RECORD, pendulum, PARAMS), 2),
    ):
        with pytest.raises(TypeError, match=rf"argument {place} here.\nFix: .*\(system, "):
            act()


BY_NAME = {
    "integrate": (lambda: lj.integrate(pendulum, 1.0, 0.0, PARAMS, TS), "ts"),
    "poincare": (lambda: lj.poincare(pendulum, 1.0, 0.0, PARAMS, ts=TS), "section"),
    "equilibria": (lambda: lj.equilibria(pendulum, PARAMS, [1.0]), "starts"),
    "continue_equilibria": (lambda: lj.continue_equilibria(pendulum, PARAMS, 1.0, "g", 3.0), "along and to"),
    "lyapunov_exponents": (lambda: lj.lyapunov_exponents(pendulum, 1.0, 0.0, PARAMS, TS), "ts"),
    "work_precision": (lambda: lj.work_precision(pendulum, 1.0, 0.0, PARAMS, TS), "ts"),
    "horizons": (lambda: lj.horizons(pendulum, 1.0, 0.0, PARAMS), "period"),
}


@pytest.mark.parametrize("name", BY_NAME)
def test_what_is_given_by_name(name):
    """Times, starts or a section given by position, or left out, raise."""
    act, words = BY_NAME[name]
    with pytest.raises(
        TypeError, match=rf"lj.{name} was called .*\n.*{words} given by position.*\nFix: lj.{name}\(system"
    ):
        act()


def test_what_python_says_better_is_left_to_it():
    """Python's own errors remain for an unknown keyword and too few arguments, and the signature is unchanged."""
    with pytest.raises(TypeError, match="unexpected keyword argument 't_span'"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, t_span=(0.0, 1.0))  # pyright: ignore[reportCallIssue]
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'v0'"):
        lj.integrate(pendulum, 1.0, ts=TS)  # pyright: ignore[reportCallIssue]
    assert list(inspect.signature(lj.integrate).parameters)[:5] == ["system", "q0", "v0", "params", "ts"]
    assert float(lj.momentum(pendulum, 0, jnp.asarray(1), 2, PARAMS)) == 2.0
