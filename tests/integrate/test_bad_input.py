"""Bad input raises an error in the user's terms: what happened, the usual cause, the fix."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from tests.systems import HORIZONTAL, PARAMS, TS, pendulum, rod_pendulum

sphere = lj.System(lambda t, q, v, params: 0.5 * (v["psi"] ** 2 + jnp.sin(q["psi"]) ** 2 * v["theta"] ** 2))


def refusal(kind, *parts):
    """Expect an error whose message holds all `parts` and a fix."""
    pattern = "(?s)" + "".join(f"(?=.*{part})" for part in (*parts, "Fix:"))
    return pytest.raises(kind, match=pattern)


def test_wrong_structure():
    """v lacks one of q's coordinates."""
    with refusal(ValueError, "structure of q", "theta"):
        lj.integrate(sphere, {"psi": 1.0, "theta": 0.0}, {"psi": 0.0}, ts=TS)


def test_wrong_shape():
    """v has another shape than q: the message names the coordinate."""
    with refusal(ValueError, "'y'", r"\(2,\)"):
        lj.integrate(rod_pendulum, {"x": 1.0, "y": np.zeros(2)}, {"x": 0.0, "y": 0.0}, PARAMS, ts=TS)


def test_lagrangian_not_scalar():
    """Energies left unsummed."""
    with refusal(ValueError, "one real number", r"\(2,\)", "jnp.sum"):
        lj.integrate(lj.System(lambda t, q, v, params: 0.5 * v**2), np.zeros(2), np.zeros(2), ts=TS)


def test_force_of_another_structure():
    """A force with another structure than q."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2, force=lambda t, q, v, params: jnp.zeros(3))
    with refusal(ValueError, "like q"):
        lj.integrate(system, 0.0, 1.0, ts=TS)


def test_no_numbers_in_the_start():
    """A condition, text or a function as a coordinate is named, with what may have been meant."""
    for start, words in ((True, "'psi' of q is bool"), ("1.0", "'1.0'"), (lambda: 1.0, "a function"), ({1.0}, "{1.0}")):
        with refusal(TypeError, words, "Usual cause"):
            lj.integrate(sphere, {"psi": start, "theta": 0.0}, {"psi": 0.0, "theta": 1.0}, ts=TS)
    for start in (None, {}, [], np.zeros(0)):
        with refusal(ValueError, "q has no coordinates"):
            lj.integrate(pendulum, start, start, PARAMS, ts=TS)


def test_not_hashable_in_params():
    """A set in params is named, in a call and in a compiled one; twin: a frozenset is fine."""
    choice = lambda kind: {"rules": {"axes": kind(["psi"])}}
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - (2.0 * q if "psi" in p["rules"]["axes"] else 0.0))
    calls = (
        lambda kind: lj.accelerations(system, 0.0, 0.0, 0.0, choice(kind))[0],
        lambda kind: jax.jit(lambda q: lj.accelerations(system, 0.0, q, 0.0, choice(kind))[0])(0.0),
        lambda kind: 2 * lj.integrate(system, 0.0, 0.0, choice(kind), ts=[0.0, 1.0]).q[-1],
    )
    for call in calls:
        np.testing.assert_allclose(call(frozenset), -2.0, rtol=1e-9)
        with refusal(TypeError, r"'rules\.axes' of params is \{'psi'\}", "frozenset"):
            call(set)


def test_float32_out_of_reach():
    """A tolerance below float32's round-off is refused, with the switch to float64 as the fix."""
    with refusal(ValueError, "rtol = 1e-09", "float32", "jax_enable_x64"):
        lj.integrate(pendulum, np.float32(1.0), np.float32(0.0), PARAMS, ts=TS, rtol=1e-9)


def test_tolerance_out_of_reach_in_float64():
    """A tolerance below float64's round-off is refused, too."""
    with refusal(ValueError, "rtol = 1e-17", "float64"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, rtol=1e-17)


def test_nan_from_the_lagrangian():
    """L is NaN at the start, although its derivatives are finite: the log of a negative number."""
    system = lj.System(lambda t, q, v, params: 0.5 * v**2 + jnp.log(q))
    with refusal(ValueError, "L is nan", "q = -1"):
        lj.integrate(system, -1.0, 1.0, ts=TS)


def test_nan_in_a_derivative():
    """L is finite but its derivative is not: sqrt at zero; the message names the coordinate."""
    system = lj.System(lambda t, q, v, params: 0.5 * (v["a"] ** 2 + v["b"] ** 2) - jnp.sqrt(q["b"]))
    with refusal(ValueError, "coordinate 'b'", "sqrt"):
        lj.integrate(system, {"a": 1.0, "b": 0.0}, {"a": 0.0, "b": 0.0}, ts=TS)


def test_nan_in_the_start():
    """A NaN coordinate is named."""
    with refusal(ValueError, "'theta' of v0 is nan"):
        lj.integrate(sphere, {"psi": 1.0, "theta": 0.0}, {"psi": 0.0, "theta": np.nan}, ts=TS)


def test_pole():
    """Polar coordinates at the pole: the azimuth's mass vanishes."""
    for act in (
        lambda q, v: lj.integrate(sphere, q, v, ts=TS),
        lambda q, v: lj.accelerations(sphere, 0.0, q, v, None),
    ):
        with refusal(ValueError, "singular in coordinate 'theta'", "Cartesian"):
            act({"psi": 0.0, "theta": 0.0}, {"psi": 1.0, "theta": 0.0})


def test_missing_velocity():
    """A coordinate without kinetic energy."""
    system = lj.System(lambda t, q, v, params: 0.5 * v["a"] ** 2 - q["b"] ** 2)
    with refusal(ValueError, "singular in coordinate 'b'"):
        lj.integrate(system, {"a": 1.0, "b": 0.5}, {"a": 0.0, "b": 0.0}, ts=TS)


@pytest.mark.exhaustive
def test_constraint_without_a_derivative():
    """A squared constraint has no derivative where it holds: it is named, and does not count as redundant."""
    rod = rod_pendulum.constraints["rod"]
    assert isinstance(rod, lj.Holonomic)
    squared = lj.Holonomic(lambda t, q, params: rod.g(t, q, params) ** 2)
    system = lj.System(rod_pendulum.lagrangian, {"rod": rod, "squared": squared})
    with refusal(ValueError, "constraint 'squared' does not act independently"):
        lj.accelerations(system, 0.0, *HORIZONTAL, PARAMS)
    alone = lj.System(rod_pendulum.lagrangian, {"squared": squared})
    with refusal(ValueError, "constraint 'squared' does not act independently"):
        lj.integrate(alone, *HORIZONTAL, PARAMS, ts=TS)


def test_start_off_the_constraint():
    """An inconsistent start is refused, with the residuals of positions and velocities and with the remedy."""
    q0, v0 = {"x": 1.3, "y": 0.1}, {"x": 0.2, "y": -1.0}
    with refusal(ValueError, "off the constraints", "'rod' = 0.138", "d/dt 'rod'", "consistent_state"):
        lj.integrate(rod_pendulum, q0, v0, PARAMS, ts=TS)


@pytest.mark.exhaustive
def test_the_remedy_for_a_start_off_the_constraint():
    """The advised remedy works; twin: without it the same start is refused, above."""
    q0, v0 = {"x": 1.3, "y": 0.1}, {"x": 0.2, "y": -1.0}
    traj = lj.integrate(rod_pendulum, *lj.consistent_state(rod_pendulum, 0.0, q0, v0, PARAMS), PARAMS, ts=TS)
    assert float(traj.residual()) < 1e-14


@pytest.mark.slow
def test_a_constraint_may_have_any_name():
    """A constraint's name that contains a bracket is not mistaken for an index."""
    system = lj.System(rod_pendulum.lagrangian, {"rod[left]": rod_pendulum.constraints["rod"]})
    with refusal(ValueError, r"d/dt 'rod\[left\]' = 1"):
        lj.integrate(system, {"x": 1.25, "y": 0.0}, {"x": 0.4, "y": 0.0}, PARAMS, ts=TS)


@pytest.mark.exhaustive
def test_unreachable_constraint():
    """No consistent state exists: the error gives the residual by name."""
    system = lj.System(rod_pendulum.lagrangian, {"ghost": lj.Holonomic(lambda t, q, params: q["x"] ** 2 + 1.0)})
    with refusal(ValueError, "no consistent state", "'ghost'"):
        lj.consistent_state(system, 0.0, {"x": 1.0, "y": 0.0}, {"x": 0.0, "y": 0.0}, PARAMS)


@pytest.mark.parametrize(
    ("ts", "words"),
    [
        ([0.0, 1.0, 0.5], r"ts\[2\] = 0.5 follows ts\[1\] = 1"),
        ([2.0, 0.0, 1.0], r"must decrease throughout.*ts\[2\] = 1 follows ts\[1\] = 0"),
        ([0.0, 1.0, 1.0], "must increase"),
        ([0.0], "at least two times"),
        (3.0, "at least two times"),
        (None, "two times, and is None"),
        ("0..1", "two times, and is '0..1'"),
        (["0", "1"], r"two times, and is \['0', '1'\]"),
        ([0j, 1j], "two times, and is"),
        (np.ones((2, 2)), r"has shape \(2, 2\)"),
    ],
)
def test_times(ts, words):
    """`ts` that is not monotonic, or is not a vector."""
    with refusal(ValueError, words):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=ts)


OPTIONS = {
    "dt0": ("small", ValueError, "one positive number, not 'small'"),
    "rtol": ("1e-9", ValueError, "It is '1e-9'"),
    "atol": (1j, ValueError, "one number, or two"),
    "max_steps": (1e6, ValueError, r"not 1000000.0.*10\*\*6"),
    "adjoint": ("backsolve", TypeError, "an adjoint of diffrax, not str"),
    "stepsize_controller": (diffrax.PIDController, TypeError, "the class PIDController"),
}


@pytest.mark.parametrize("name", OPTIONS)
def test_options_of_another_kind(name):
    """Text for a number, a float for a count, a class for an instance: the option is named before anything runs."""
    given, kind, words = OPTIONS[name]
    with refusal(kind, name, words):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **{name: given})


@pytest.mark.parametrize("name", ("dt0", "max_step"))
def test_lengths_of_steps(name):
    """`dt0` and `max_step` that are not positive are refused; while tracing, in the result."""
    with refusal(ValueError, f"{name} must be one positive number, not -0.1", "where ts decreases"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **{name: -0.1})
    run = jax.jit(lambda x: lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, throw=False, **{name: x}).result)
    assert run(-0.1) == lj.RESULTS.unordered


def test_times_of_jumps():
    """`jump_ts` that is not a vector of finite times."""
    for jump_ts, words in ((np.ones((2, 2)), "vector of times"), ([0.5, np.nan], "NaN or infinity"), (["a"], "vector")):
        with refusal(ValueError, "jump_ts", words):
            lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, jump_ts=jump_ts)


def test_limits_on_steps_that_another_controller_chooses():
    """`max_step` and `jump_ts` together with a controller: the message says what the controller takes instead."""
    given = {"stepsize_controller": diffrax.PIDController(rtol=1e-6, atol=1e-6)}
    with refusal(ValueError, "max_step", "dtmax"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **given, max_step=0.1)
    with refusal(ValueError, "jump_ts", "ClipStepSizeController"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, **given, jump_ts=[0.5])
    with refusal(ValueError, "jump_ts", "BacksolveAdjoint"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, adjoint=diffrax.BacksolveAdjoint(), jump_ts=[0.5])


def test_solver_class():
    """The class instead of an instance."""
    with refusal(TypeError, "Tsit5 is the class", r"diffrax.Tsit5\(\)"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, method=diffrax.Tsit5)


def test_solver_for_split_fields():
    """A method that needs a separable field."""
    with refusal(TypeError, "SemiImplicitEuler", "of a special form"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, method=diffrax.SemiImplicitEuler())


def test_adjoint_that_leaves_the_constraints():
    """BacksolveAdjoint is refused for a constrained system, where it would be silently wrong."""
    with refusal(ValueError, "BacksolveAdjoint"):
        lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS, adjoint=diffrax.BacksolveAdjoint())


@pytest.mark.slow
def test_max_steps():
    """The message says where the motion stopped, after how many steps, how many are missing, and what to do."""
    with refusal(RuntimeError, "stopped at t = 0", "max_steps = 4", r"needs \d more", r"max_steps=\d+, or"):
        lj.integrate(pendulum, 1.0, 0.0, PARAMS, ts=TS, max_steps=4)


def test_singularity_on_the_way():
    """A fall into the centre is reported with the state where it happened, not as `max_steps`."""
    kepler = lj.System(lambda t, q, v, params: 0.5 * v**2 + 1 / q)
    with refusal(RuntimeError, "stopped at t = 1.1107", "(singularity|not finite|L is)"):
        lj.integrate(kepler, 1.0, 0.0, ts=np.array([0.0, 2.0]))


def test_not_a_system():
    """The Lagrangian itself is passed instead of the system."""
    with refusal(TypeError, "lj.System"):
        lj.integrate(pendulum.lagrangian, 1.0, 0.0, PARAMS, ts=TS)


def test_called_lagrangian_and_bare_constraint():
    """`System` refuses a value instead of a function, and a constraint without a kind."""
    with refusal(TypeError, "lagrangian must be a function"):
        lj.System(3.0)
    with refusal(TypeError, "'rod'", "lj.Holonomic"):
        lj.System(pendulum.lagrangian, {"rod": lambda t, q, params: q})
    with refusal(TypeError, "kinetic and potential energy given separately", "return kinetic - potential"):
        lj.System(pendulum.lagrangian, pendulum.lagrangian)
    with refusal(TypeError, "params in the place of constraints", "each call takes them"):
        lj.System(pendulum.lagrangian, PARAMS)
    with refusal(TypeError, "named 3, but its name must be text"):
        lj.System(pendulum.lagrangian, {3: lj.Holonomic(lambda t, q, params: q)})


def test_unknown_drift():
    """A misspelt option is refused."""
    with pytest.raises(ValueError, match="drift"):
        lj.integrate(rod_pendulum, *HORIZONTAL, PARAMS, ts=TS, drift="projct")


def test_failure_under_jit_is_not_silent():
    """Inside jit a failed integration raises at run time; with throw=False it carries its result."""
    run = jax.jit(lambda q0, throw: lj.integrate(
        pendulum, q0, 0.0, PARAMS, ts=TS, throw=throw).result, static_argnums=1)  # fmt: skip
    with pytest.raises(RuntimeError, match="not finite"):
        jax.block_until_ready(run(jnp.nan, True))
    assert bool(run(jnp.nan, False) == lj.RESULTS.start_not_finite)
