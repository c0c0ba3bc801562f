"""The balance of forces and its small departures: shared multipliers, roots and their derivatives."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.analysis.balance import (
    Equilibria,
    Steady,
    SteadySymmetries,
    balance,
    departures,
    merged,
    shortest_multipliers,
)
from lagjax.analysis.equilibria import _zero_modes
from lagjax.scenes import cross_rails
from lagjax.system.model import model_of
from tests.analysis.steady_systems import DISK, UPRIGHT_DISK, disk, straight_on
from tests.by_numpy import by_numpy
from tests.systems import PARAMS, cartesian_lagrangian, rod, rod_pendulum
from tests.tiers import exhaustive_but


@pytest.mark.slow
@pytest.mark.parametrize("times", exhaustive_but((1,), (1, 2)))
def test_multiplier_and_redundant_rods(times):
    """2 y λ = g, shared by redundant rods as multipliers of least norm; twin: λ has the other sign above."""
    again = lj.Holonomic(lambda t, q, params: 2 * rod(t, q, params))
    two = lj.System(cartesian_lagrangian, {"rod": lj.Holonomic(rod), "again": again})
    starts = [{"x": 0.3, "y": -1.0}, {"x": 0.3, "y": 1.0}]
    g, l = PARAMS["g"], PARAMS["l"]
    system, share = (rod_pendulum, 1.0) if times == 1 else (two, 0.2)
    found = lj.equilibria(system, PARAMS, starts=starts)
    np.testing.assert_allclose(found.q["y"], [-l, l], rtol=1e-14)
    np.testing.assert_allclose(found.multipliers["rod"], share * g / (2 * found.q["y"]), rtol=1e-13)
    assert found.stable.tolist() == [True, False]
    if times == 2:
        np.testing.assert_allclose(found.multipliers["again"], 0.4 * g / (2 * found.q["y"]), rtol=1e-13)
    assert found.multipliers["rod"][0] < 0 < found.multipliers["rod"][1]
    if times == 1:
        # The table has one line for each equilibrium: state, multipliers, stability.
        lines = repr(found).splitlines()
        assert lines[0] == "Equilibria: 2 from 2 starts" and lines[1].split() == ["x", "y", "λ", "rod"]
        assert lines[2].split() == ["0", "-1.25", "-3.925", "stable"] and lines[3].endswith("unstable")


def test_shortest_multipliers():
    """Of redundant forces those of least norm, as by NumPy's pseudo-inverse; forces of zero have none."""
    pushes = np.random.default_rng(0).normal(size=(2, 3))[[0, 0, 1, 1]] * np.array([[1.0], [2.0], [0.0], [-1.0]])
    known = np.array([0.5, -1.0]) @ pushes[[0, 3]]
    found = by_numpy(shortest_multipliers)(pushes, known)
    np.testing.assert_allclose(found, np.linalg.pinv(pushes.T) @ known, rtol=1e-12, atol=1e-15)


@pytest.mark.exhaustive
def test_roots_are_those_of_the_linearisation():
    """Two derivations agree: gyroscopic, holonomic and velocity constraints, all kinds of forces."""
    rng = np.random.default_rng(3)
    matrices = {name: rng.normal(size=(4, 4)) for name in "KMDGN"}
    params = {name: x @ x.T + np.eye(4) if name in "KMD" else x for name, x in matrices.items()}
    params |= {"f": rng.normal(size=4), "c": rng.normal(size=4)}

    def lagrangian(t, q, v, p):
        return 0.5 * (v @ p["M"] @ v - q @ p["K"] @ q) + q @ p["G"] @ v + p["f"] @ q - 0.1 * jnp.sum(q**4)

    surface = lj.Holonomic(lambda t, q, p: p["c"] @ q - 0.3 + 0.2 * q @ q)
    general = lj.System(
        lagrangian, {"surface": surface}, lambda t, q, v, p: 0.1 * p["N"] @ q, lambda t, q, v, p: 0.05 * v @ p["D"] @ v
    )
    straight = {name: np.asarray(x) * 3.0 for name, x in straight_on(UPRIGHT_DISK, DISK).items()}
    cases = [
        (general, params, np.zeros(4), {}),
        (cross_rails.rotating_system, cross_rails.PARAMS | {"omega": 8.0}, {"R": -0.8, "r": 0.0}, {}),
        (disk, DISK, UPRIGHT_DISK, {"velocities": straight, "cyclic": straight_on}),
    ]
    for system, p, start, settings in cases:
        found = lj.equilibria(system, p, starts=[start], **settings)
        theirs = np.asarray(lj.linearise(system, *found[0]).eigenvalues())
        mine = np.asarray(found.eigenvalues[0])
        mine = mine[np.isfinite(mine)]
        largest = np.max(np.abs(theirs))
        mine, theirs = (x[np.abs(x) > 1e-6 * largest] for x in (mine, theirs))
        assert mine.size == theirs.size > 0
        off = np.abs(mine[:, None] - theirs[None, :])
        assert max(off.min(axis=0).max(), off.min(axis=1).max()) < 1e-12 * largest


def test_balance_and_departures_on_a_rod():
    """r = M a - F - Aᵀ λ = 0 and g = 0 where 2 y λ = g; K is -2 λ, M is one. Twin: λ of the other sign."""
    l, g = PARAMS["l"], PARAMS["g"]
    steady = Steady(model_of(rod_pendulum, 0.0, {"x": 0.0, "y": -l}, {"x": 0.0, "y": 0.0}, PARAMS), np.array(0.0),
                    np.zeros(0), np.array([0.0, -l]), SteadySymmetries())  # fmt: skip
    at = by_numpy(lambda y: balance(steady, y))
    for side in (-1, 1):
        y = np.array([0.0, side * l, side * g / (2 * l)])
        np.testing.assert_allclose(at(y), 0.0, atol=1e-14)
        np.testing.assert_allclose(at(y * [1, 1, -1]), [0.0, 2 * g, 0.0], atol=1e-14)
        jacobian = by_numpy(jax.jacfwd(lambda y: balance(steady, y)))(y)
        found = by_numpy(lambda y, jacobian: departures(steady, y, jacobian))(y, jacobian)
        np.testing.assert_allclose(found.stiffness, -2 * y[2] * np.eye(2), atol=1e-14)
        np.testing.assert_allclose(found.mass, np.eye(2))
        np.testing.assert_allclose([found.rows[0], found.pushes[0]], [[0.0, 2 * side * l]] * 2, atol=1e-14)
        np.testing.assert_array_equal([*found.damping.ravel(), *found.slopes.ravel()], 0.0)


def test_equal_equilibria_are_merged():
    """Angles a turn apart, with the same roots and verdict, are one equilibrium; twin: lengths are two."""
    q, of = np.array([0.25, 2 * np.pi + 0.25, 0.25, 0.5]), np.arange(4)
    found = lambda angle, *radii: merged(Equilibria(**fields), np.array([angle]), np.array(radii))
    fields = dict.fromkeys(Equilibria.__dataclass_fields__, None) | {"q": q, "v": 0 * q, "multipliers": {}}
    fields |= {"eigenvalues": np.array([[1j, -1j], [1j, -1j], [2j, -2j], [1j, -1j]]), "symmetries": SteadySymmetries()}
    fields |= dict.fromkeys(("rates", "momenta", "zero_modes", "soft", "imbalance"), of)
    fields |= {"stable": of >= 0, "undecided": of < 0, "found": of >= 0}
    assert found(True, 0, 0, 0, 0).of_start.tolist() == [0, 0, 1, 2] and len(found(True, 0, 0, 0, 0)) == 3
    assert found(False, 0, 0, 0, 0).of_start.tolist() == [0, 1, 2, 3]
    # At a multiple root, which is known to within a radius, the roots do not count.
    assert found(True, 0, 0, 0, 1).of_start.tolist() == [0, 0, 1, 0]


def test_directions_in_which_the_balance_holds():
    """Of a mass on a rod: none where a force restores it along that, and one where none does, whatever acts across.
    Twin: the multiplier is a direction too, in which the balance does not hold."""

    @jax.jit
    def zero_modes(matrix):
        steady = SimpleNamespace(n=2, m=1, symmetries=SimpleNamespace(count=0), fields=lambda y: jnp.zeros((0, 2)))
        return _zero_modes(steady, SimpleNamespace(jacobian=matrix, rows=jnp.ones(3), y=jnp.zeros(3)))[0]

    on_a_rod = lambda along, across: np.array([[along, 0.0, 0.0], [0.0, across, -2.5], [0.0, -2.5, 0.0]])
    for along, across in itertools.product((7.85, 0.0), (0.0, 3.0)):
        matrix = on_a_rod(along, across)
        assert int(zero_modes(matrix)) == (along == 0) == 3 - np.linalg.matrix_rank(matrix)
