"""The measured double pendulum of `learned.py`: known L, learned friction.

The record is that of `fit_measured_pendulum.py`, which describes its origin, how a file is recognised, and its L:

    L/B = A θ1'²/2 + θ2'²/2 + C θ1' θ2' cos(θ1 - θ2) - D cos θ1 - E cos θ2

It is not part of this project: name it with `--record FILE` or `LAGJAX_DOUBLE_PENDULUM`. Without it a record is
simulated from the published parameters, with errors of 0.2 mrad; its friction is viscous, so the network has nothing
else to find.

    viscous           the six coefficients, trained from the published ones
    learned friction  A, C, D, E likewise, and the force -D(q, v) v with a network for its positive-definite matrix

They are compared with the neural ODE and the Hamiltonian network, which know nothing in advance, and with the published
parameters. The training data are 60 s in three parts; the judged motions start in the 10 s after the first and after
the second part. The score after 1 and 10 natural times of 0.83 s is the largest error of an angle until then, as the
median over the initial states. Finally a motion runs from the start of the record to its end: its phase is lost, so its
score is the largest error of the energy that friction leaves, by the published coefficients and divided by E. Initial
states are smoothed positions, which limit the accuracy.
"""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.signal import savgol_filter

import lagjax as lj
from benchmarks.accuracy.fit_measured_pendulum import published_double
from benchmarks.learned.models import Setting, factor, hamiltonian, layers, neural_ode, of_lagrangian
from benchmarks.learned.scores import until
from benchmarks.learned.systems import turned, windows
from benchmarks.measure import row, skipped

PUBLISHED = published_double()
NAMES = tuple(PUBLISHED)
NATURAL, STEP, WINDOW, SIGMA = 0.83, 0.01, 31, 0.0002
# Seconds of the record used for training, and for judging.
TRAINED, JUDGED, BLOCK, GAP = (0.0, 30.0, 60.0), (20.0, 50.0), 20.0, 10.0


def record_of(path):
    """Times, angles (T, 2) at equal steps, and whether the record was measured."""
    if path:
        with open(path) as file:
            columns = [name.split("[")[0].strip() for name in file.readline().split(",")]
            named = dict(zip(columns, np.loadtxt(file, delimiter=",").T))
        every = round(STEP / float(named["t"][1] - named["t"][0]))
        return named["t"][::every], np.stack([named["theta1"], named["theta2"]], axis=1)[::every]
    ts = np.arange(0.0, 80.0, STEP)
    start = np.array([0.6, 1.6]), np.zeros(2)
    motion = lj.integrate(
        lj.System(lagrangian, dissipation=viscous),
        *start,
        PUBLISHED,
        ts=ts,
        rtol=1e-10,
        atol=1e-10,
        estimate_error=False,
    )
    return ts, np.asarray(motion.q) + SIGMA * np.random.default_rng(1).standard_normal((len(ts), 2))


def lagrangian(t, q, v, p):
    """L/B, with angles from the upper vertical."""
    kinetic = 0.5 * p["A"] * v[0] ** 2 + 0.5 * v[1] ** 2 + p["C"] * v[0] * v[1] * jnp.cos(q[0] - q[1])
    return kinetic - p["D"] * jnp.cos(q[0]) - p["E"] * jnp.cos(q[1])


def viscous(t, q, v, p):
    """R/B of viscous friction in both joints."""
    return 0.5 * p["k1"] * v[0] ** 2 + 0.5 * p["k2"] * (v[1] - v[0]) ** 2


def mass(q):
    """The published M/B, for momenta."""
    across = PUBLISHED["C"] * jnp.cos(q[0] - q[1])
    return jnp.stack([
        jnp.stack([jnp.full_like(across, PUBLISHED["A"]), across]), jnp.stack([across, jnp.ones_like(across)])
    ])  # fmt: skip


SETTING = Setting("measured pendulum", 2, turned, 8.0, PUBLISHED["E"], mass, friction=True)


def coefficients(weights):
    """Coefficients from weights, which are 10 ln(coefficient / published): a step of 0.01 changes one by 0.1 %."""
    return {name: PUBLISHED[name] * jnp.exp(0.1 * x) for name, x in weights["coefficients"].items()}


def of_coefficients(name, names, first, force=None, dissipation=None):
    """A model with known L, whose weights are coefficients and those that `first(random)` adds."""
    system = lj.System(lambda t, q, v, w: lagrangian(t, q, v, coefficients(w)), force=force, dissipation=dissipation)
    start = lambda random: {"coefficients": {name: np.zeros(()) for name in names}} | first(random)
    return of_lagrangian(name, system, start)


def friction(t, q, v, weights):
    """-D Dᵀ w in the joints, w = (θ1', θ2' - θ1'): it removes energy for any network."""
    joints = jnp.stack([v[0], v[1] - v[0]])
    x = jnp.concatenate([turned(q), joints / SETTING.speed])
    damping = factor(weights["friction"], x, 2)
    torque = 0.1 * damping @ (damping.T @ joints)
    return jnp.stack([torque[1] - torque[0], -torque[1]])


def models():
    """The four models that are trained."""
    learned = lambda random: {"friction": layers(random, 6, 24, 24, 3)}
    known = of_coefficients("learned friction", NAMES[:4], learned, force=friction)
    numbers = 1500
    return [
        of_coefficients("viscous", NAMES, lambda random: {},
                        dissipation=lambda t, q, v, w: viscous(t, q, v, coefficients(w))),
        known, neural_ode(SETTING, numbers, 2), hamiltonian(SETTING, numbers, 2),
    ]  # fmt: skip


def energies(q, v):
    """The energy by the published coefficients, divided by E; zero if both arms hang down."""
    kinetic = 0.5 * PUBLISHED["A"] * v[..., 0] ** 2 + 0.5 * v[..., 1] ** 2
    kinetic += PUBLISHED["C"] * v[..., 0] * v[..., 1] * np.cos(q[..., 0] - q[..., 1])
    height = PUBLISHED["D"] * (1 + np.cos(q[..., 0])) + PUBLISHED["E"] * (1 + np.cos(q[..., 1]))
    return (kinetic + height) / PUBLISHED["E"]


def judge(model, ts, angles, smooth):
    """`score(weights)`: errors of angles after 1 and 10 natural times, and of the energy from start to end."""
    near = [i for begin in JUDGED for i in np.arange(begin + 0.1, begin + GAP - NATURAL - 0.1, 1.0)]
    far = [begin + s for begin in JUDGED for s in np.linspace(0.1, GAP - 10 * NATURAL - 0.1, 4)]
    runs = {}
    for horizon, starts in ((1, near), (10, far)):
        steps = np.arange(0, round(horizon * NATURAL / STEP) + 1, 5)
        first = np.searchsorted(ts, ts[0] + np.array(starts))
        run = jax.jit(
            jax.vmap(lambda w, q0, v0, times=steps * STEP: model.motion(w, q0, v0, times, 1e-6), (None, 0, 0))
        )
        runs[horizon] = run, first, angles[first[:, None] + steps], steps * STEP
    begin, end = 10, len(ts) - 10
    whole = jax.jit(lambda w, q0, v0: model.motion(w, q0, v0, ts[begin:end:20] - ts[begin], 1e-6))
    left = energies(*(x[begin:end:20] for x in smooth))

    def score(weights):
        found = []
        for run, first, right, times in runs.values():
            q, _ = run(weights, *(x[first] for x in smooth))
            found.append(until(np.abs(np.asarray(q) - right).max(axis=2), times, times[-1]))
        motion = [np.asarray(x) for x in whole(weights, *(x[begin] for x in smooth))]
        return [*found, until(np.abs(energies(*motion) - left)[None], np.arange(len(left)), len(left))]

    return score


def rows(wanted, path, taught_by):
    """The rows of the published model, then those of the trained models."""
    title = SETTING.name if path else "made pendulum"
    asked = [model for model in models() if wanted(f"{title}, {model.name}")]
    if not asked and not wanted(f"{title}, published"):
        return
    if not path:
        yield skipped("measured pendulum", "no record; --record FILE names one. What follows is of one that is made.")
    ts, angles = record_of(path)
    smooth = [savgol_filter(angles, 11, 5, deriv=order, delta=STEP, axis=0) for order in range(2)]
    blocks = [np.searchsorted(ts, ts[0] + begin) for begin in TRAINED]
    size = min(round(BLOCK / STEP), len(ts) - max(blocks))
    cut = windows(np.stack([angles[i : i + size] for i in blocks]), STEP, WINDOW, SIGMA)
    names = ("1 natural times", "10 natural times", "energy, the whole record")
    if wanted(f"{title}, published"):
        as_it_is = of_coefficients("published", NAMES, lambda random: {},
                                   dissipation=lambda t, q, v, w: viscous(t, q, v, coefficients(w)))  # fmt: skip
        weights = as_it_is.first(None)
        for name, value in zip(names, judge(as_it_is, ts, angles, smooth)(weights)):
            yield row(f"{title}, published: {name}", value)
    energy_of = {}
    for model in asked:
        several = taught_by(model, cut, SIGMA, judge(model, ts, angles, smooth))
        for i, name in enumerate(names):
            yield several.row(f"{title}, {model.name}: {name}", i)
        energy_of[model.name] = float(np.median(several.found[:, 1]))
    if "learned friction" in energy_of and len(asked) == 4:
        others = min(energy_of["neural ODE"], energy_of["Hamiltonian"])
        yield row(
            f"{title}: 10 natural times, learned friction / the better network",
            energy_of["learned friction"] / others,
            1.0,
        )
