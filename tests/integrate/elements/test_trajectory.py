"""What is done with a motion with elements: a block that bounces, slides and stops, in closed form."""

import functools
from importlib import import_module

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.integrate import HybridTrajectory
from lagjax.integrate.meeting import Met

# The package hands out a function of this name.
explain = import_module("lagjax.analysis.explain")
PARAMS = {"g": 9.81, "mu": 0.1}
G, MU, E, THROWN = 9.81, 0.1, 0.5, 4.0
FALL = np.sqrt(2 / G)
# Impacts in the ratio e; each takes μ of its impulse from the sliding velocity. Then it slides and stops.
RESTS = FALL * (1 + 2 * E / (1 - E))
SPEED = THROWN - MU * G * FALL * (1 + E) / (1 - E)
STOPS = RESTS + SPEED / (MU * G)

floor = lj.Contact(
    lambda t, q, p: q[1], restitution=E, friction=lambda p: p["mu"], sliding=lambda t, q, v, p: v[0]
)  # fmt: skip
block = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - p["g"] * q[1], elements={"floor": floor})


def thrown(mu=MU, ts=(0.0, 1.0, 5.0), **options) -> HybridTrajectory:
    """The block thrown from height 1."""
    start = np.array([0.0, 1.0]), np.array([THROWN, 0.0])
    traj = lj.integrate(block, *start, PARAMS | {"mu": mu}, ts=np.array(ts), estimate_error=False, **options)
    assert isinstance(traj, HybridTrajectory)
    return traj


computed = functools.cache(thrown)


@pytest.mark.exhaustive
def test_between_outputs():
    """In flight, between impacts, sliding and at rest as in closed form, from outputs far apart. Twin: free fall."""
    traj = computed()
    u, t = E * G * FALL, np.array([0.3, 0.7, 3.0, 4.5])
    found = traj.at(t)
    after = THROWN - MU * (1 + E) * G * FALL
    slid = SPEED - MU * G * (3.0 - RESTS)
    np.testing.assert_allclose(found.v[:, 0], [THROWN, after, slid, 0.0], atol=1e-8)
    height = u * (0.7 - FALL) - G / 2 * (0.7 - FALL) ** 2
    np.testing.assert_allclose(found.q[:, 1], [1 - G / 2 * 0.3**2, height, 0.0, 0.0], atol=1e-8)
    np.testing.assert_allclose(found.multipliers["floor"], [0.0, 0.0, G, G], rtol=1e-9)
    np.testing.assert_allclose(found.multipliers["floor friction"], [0.0, 0.0, -MU * G, 0.0], rtol=1e-9, atol=1e-12)
    lost = MU * (1 + E) * G * FALL
    way = THROWN * FALL + sum((THROWN - lost * (1 - E**n) / (1 - E)) * 2 * FALL * E**n for n in range(1, 60))
    np.testing.assert_allclose(traj.q[-1], [way + SPEED**2 / (2 * MU * G), 0.0], atol=1e-5)
    np.testing.assert_allclose(traj.switches.t[0], FALL, rtol=1e-10)
    assert np.asarray(traj.modes).tolist() == [[0, 0], [0, 0], [1, 2]] and thrown(0.9 * MU).q[-1, 0] > way
    assert np.all(1 - G / 2 * t[1:] ** 2 < found.q[1:, 1] - 1.0)
    assert float(traj.residual()) < 1e-14 and abs(float(traj.switches.t[len(traj.switches) - 1]) - STOPS) < 1e-6
    assert "at the end: floor closed, floor friction sticks" in repr(traj)
    assert "floor is struck, then open" in repr(traj.switches)


@pytest.mark.slow
def test_in_a_file(tmp_path):
    """It comes back bit for bit, and continues; in a dataset modes are a variable by their names. Twins: with another
    restitution, or another friction of the same sliding velocity, it is another system."""
    traj, path = computed(), tmp_path / "motion.npz"
    traj.save(path)
    numbers = lambda traj: jax.tree.leaves((traj.rows(), traj.switches, traj.end, traj.events, traj.stats))
    again, alone = lj.load_trajectory(path, block), lj.load_trajectory(path)
    for found in (again, alone):
        for a, b in zip(numbers(traj), numbers(found), strict=True):
            assert a.dtype == b.dtype and np.asarray(a).tobytes() == np.asarray(b).tobytes()
    assert repr(again) == repr(traj) and np.array_equal(again.at(0.7).q, traj.at(0.7).q)
    modes = again.to_xarray()["modes"]
    assert modes.dims == ("t", "mode") and modes.sel(mode="floor friction").values.tolist() == [0, 0, 2]
    kept = {"friction": floor.friction, "sliding": floor.sliding}
    others = lj.Contact(floor.gap, 0.6, **kept), lj.Contact(floor.gap, E, **kept | {"friction": 0.2})
    for other, words in zip(others, ("the restitution of 'floor'", "the coefficients of 'floor friction'")):
        with pytest.raises(ValueError, match=words):
            lj.load_trajectory(path, lj.System(block.lagrangian, elements={"floor": other}))


@pytest.mark.exhaustive
def test_energy_by_element():
    """Friction takes what is left at rest, impacts the rest of the energy, and the sum closes. Twin: it does not with
    another friction."""
    traj = computed()
    ledger = lj.energy_ledger(traj)
    assert ledger.closes and ledger.relative_closure < 1e-9
    np.testing.assert_allclose(ledger.elements["floor friction"].total[-1], -(SPEED**2) / 2, rtol=1e-6)
    np.testing.assert_allclose(ledger.element_impacts["floor"][-1], -(THROWN**2 - SPEED**2) / 2 - G, rtol=1e-6)
    np.testing.assert_allclose(ledger.elements["floor"].total, 0.0, atol=1e-10)
    assert "impacts of 'floor'" in repr(ledger) and set(ledger.switches) == {"floor", "floor friction"}
    rougher = lj.Contact(floor.gap, E, friction=2 * MU, sliding=floor.sliding)
    assert not lj.energy_ledger(traj, lj.System(block.lagrangian, elements={"floor": rougher})).closes
    with pytest.raises(TypeError, match="with elements by a lj.System with elements"):
        lj.energy_ledger(traj, lj.System(block.lagrangian))


@pytest.mark.exhaustive
def test_energy_of_what_moves():
    """A table that goes up and down does work on what lies on it, and a belt on what it carries."""
    table = lj.Contact(lambda t, q, p: q - 0.1 * jnp.sin(t))
    belt = lj.Friction(lambda t, q, v, p: v - 1.0, 0.5, normal=10.0)
    for name, element, potential, v0, modes in (
        ("table", table, lambda q: 10.0 * q, 0.1, [1, 1]),
        ("belt", belt, lambda q: 0.5 * q**2, 0.0, [-1, 2]),
    ):
        system = lj.System(lambda t, q, v, p, V=potential: 0.5 * v**2 - V(q), elements={name: element})
        traj = lj.integrate(system, 0.0, v0, ts=np.array([0.0, 1.0]), estimate_error=False)
        assert isinstance(traj, HybridTrajectory) and np.asarray(traj.modes)[:, 0].tolist() == modes
        work, energy = lj.energy_ledger(traj).elements[name].total[-1], 0.5 * traj.v**2 + potential(traj.q)
        np.testing.assert_allclose(work, energy[-1] - energy[0], rtol=1e-8)
        if name == "table":
            np.testing.assert_allclose(work, np.sin(1.0) + 0.005 * (np.cos(1.0) ** 2 - 1), rtol=1e-8)


def in_modes(monkeypatch, v, modes, found=True):
    """Let these be the modes that fit a state."""
    met = Met(np.array(v), np.array(modes), np.zeros(len(modes)), np.array(found))
    monkeypatch.setattr(explain, "modes_at", lambda assembly, start: met)


def test_explained(monkeypatch):
    """The modes at a state, and how free it is in them, in words and as a dict."""
    rows = []
    for y, x_dot, numbers, words, free in (
        (1.0, 0.0, [0, 0], ("open", "free"), 2),
        (0.0, 1.0, [1, 1], ("closed", "slides"), 1),
        (0.0, 0.0, [1, 2], ("closed", "sticks"), 0),
    ):
        in_modes(monkeypatch, [x_dot, 0.0], numbers)
        found = lj.explain(block, 0.0, np.array([0.0, y]), np.array([x_dot, 0.0]), PARAMS)
        assert dict(found.modes) == dict(zip(("floor", "floor friction"), words))
        rows.append(dict(found.rows))
        assert rows[-1]["in these modes"].startswith(f"{free} degree")
        assert "forces" not in rows[-1] and not found.problem
    assert "2 (gap: 1, sliding velocity: 1); here floor open (gap 1), floor friction free" in rows[0]["modes"]
    assert "up to 2 forces" in rows[0]["solved together"]
    in_modes(monkeypatch, [0.0, 0.0], [0, 0])
    inside = lj.explain(block, 0.0, np.array([0.0, -0.1]), np.zeros(2), PARAMS)
    assert "the gap 'floor' is below zero" in str(inside.problem)
    in_modes(monkeypatch, [0.0, 0.0], [1, 1], found=False)
    walls = lj.Contact(lambda t, q, params: jnp.stack([q[0], -q[0]]))
    between = lj.explain(lj.System(block.lagrangian, elements={"walls": walls}), 0.0, np.zeros(2), np.zeros(2), PARAMS)
    assert "not unique: 2 hold, 1 of them independent" in dict(between.rows)["forces"]
    assert "Painlevé" in str(between.problem)


@pytest.mark.slow
def test_drawn():
    """Under the curves a strip shows from when until when it slides and sticks."""
    pytest.importorskip("matplotlib")
    traj = computed()
    strips = traj._strips()
    assert [word for *_, word in strips["floor"]] == ["open", "closed"]
    (_, _, free), (start, end, slides), (_, last, sticks) = strips["floor friction"]
    assert (free, slides, sticks) == ("free", "slides", "sticks")
    np.testing.assert_allclose([start, end, last], [RESTS, STOPS, 5.0], atol=1e-5)
    strip = traj.plot().axes[-1]
    assert [label.get_text() for label in strip.get_yticklabels()] == ["floor", "floor friction"]
    assert [text.get_text() for text in strip.get_legend().get_texts()] == ["open, free", "closed", "slides", "sticks"]


@pytest.mark.exhaustive
def test_fitted():
    """Friction and restitution from positions; with windows it is refused in words."""
    bounces = lj.Contact(floor.gap, lambda p: p["e"], friction=floor.friction, sliding=floor.sliding)
    system = lj.System(block.lagrangian, elements={"floor": bounces})
    t = np.linspace(0.0, 3.0, 31)
    record = lj.Record(
        t, q=np.asarray(thrown(ts=tuple(t)).q), q0=np.array([0.0, 1.0]), v0=np.array([THROWN, 0.0]), hold_q=True,
        hold_v=True,
    )  # fmt: skip
    guess = PARAMS | {"mu": 0.13, "e": 0.45}
    found = lj.fit(system, record, guess, free=["mu", "e"], progress=False)
    assert found.converged
    np.testing.assert_allclose([found.params["mu"], found.params["e"]], [MU, E], atol=1e-8)
    with pytest.raises(ValueError, match="may be inside a contact"):
        lj.fit(system, record, guess, free=["mu", "e"], window=0.5)


@pytest.mark.exhaustive
def test_switches_of_lanes(tmp_path):
    """Each lane of a batch has its own switches: a block on a spring stops every half swing, nearer by 2 μ g / k, and
    rests where the spring is weaker; a lane continues, before and after it was in a file. Twin: another lane's stops.
    """
    k, lost = 100.0, 0.3 * G / 100.0
    table = lj.Friction(lambda t, q, v, p: v, 0.3, normal=G)
    system = lj.System(lambda t, q, v, p: 0.5 * v**2 - 0.5 * k * q**2, elements={"table": table})
    released = lambda q0: lj.integrate(system, q0, 0.0, ts=[0.0, 2.0], rtol=1e-10, estimate_error=False)
    starts, counts, stops = np.array([1.0, 2.0, 3.0, 5.0]) * 2 * lost, [1, 2, 3, 5], np.arange(1, 6)
    lanes = jax.vmap(released)(jnp.asarray(starts))
    assert isinstance(lanes, HybridTrajectory)
    found, expected = lanes.switches, (-1.0) ** stops * (starts[:, None] - 2 * stops * lost)
    assert found.count.tolist() == counts
    for lane, count in enumerate(counts):
        np.testing.assert_allclose(found.t[lane, :count], np.pi / 10 * stops[:count], atol=1e-9)
        np.testing.assert_allclose(found.q[lane, :count], expected[lane, :count], atol=1e-9)
        assert np.all(np.isnan(found.t[lane, count:])) and found.modes[lane, count - 1].tolist() == [2]
    assert abs(float(found.q[3, 2]) - expected[2, 2]) > 1e-3
    lanes.save(tmp_path / "lanes.npz")
    for batch in (lanes, lj.load_trajectory(tmp_path / "lanes.npz", system)):
        swings = jax.tree.map(lambda x: x[1], batch).at(0.1).q
        np.testing.assert_allclose(swings, lost + (starts[1] - lost) * np.cos(1.0), atol=1e-8)


@pytest.mark.exhaustive
def test_in_a_sweep(tmp_path):
    """Each point has its own modes, also in the store; one whose restitution is NaN fails and says so."""
    bounces = lj.Contact(lambda t, q, p: q, restitution=lambda p: p["e"])
    ball = lj.System(lambda t, q, v, p: 0.5 * v**2 - 10.0 * q, elements={"floor": bounces})
    run = lambda point: lj.integrate(ball, 5.0, 0.0, point, ts=np.linspace(0.0, 3.0, 4))
    swept = lj.sweep(run, {"e": np.array([0.0, 0.5, np.nan])}, store=tmp_path / "swept", progress=False)
    refused = lj.RESULTS[lj.RESULTS.element_refused]
    assert swept.counts() == {"successful": 2, refused: 1} and "A number of an element is NaN" in refused
    assert swept.values.modes[:2, :, 0].tolist() == [[0, 0, 1, 1], [0, 0, 0, 1]]
    stored = lj.open_sweep(tmp_path / "swept", system=ball).values
    assert np.array_equal(stored.modes, swept.values.modes)
    np.testing.assert_allclose(jax.tree.map(lambda x: x[1], stored).at(1.5).q, 1.25, atol=1e-9)
