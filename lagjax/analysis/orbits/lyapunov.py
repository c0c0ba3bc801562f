"""Lyapunov exponents: how fast neighbouring motions separate in the long run.

The flow carries a frame of tangents, which is repeatedly made orthonormal, Y = Q R. The logarithms of the diagonal of
R, divided by the elapsed time, are the rates at which tangents, areas, volumes grow; their means are the exponents λ_1
≥ λ_2 ≥ ...  With constraints the tangents are those of the constraint manifold.

The sum of all exponents is the mean of tr P J (`flow.py`). Without damping it is zero and exponents come in pairs ±λ; a
damping force -c v on unit masses makes each pair sum to -c.

Where a motion with switches sticks, or is struck without restitution, neighbouring motions meet: a direction is lost, R
has a zero, and an exponent is -∞.

A motion of finite length T gives only an estimate of an exponent. The spread of the means over ten parts of the motion
measures its uncertainty. Growth that is not exponential, such as the distance between regular motions of different
periods, which grows like t, cannot be distinguished from an exponent of about log(t)/t. The uncertainty therefore
includes one growth by a factor of ten.

Source: Benettin, Galgani, Giorgilli & Strelcyn, *Meccanica* 15 (1980) 9 and 21; Eckmann & Ruelle, *Rev. Mod. Phys.* 57
(1985) 617, §IV.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, ArrayLike, Bool, Float, PyTree

from lagjax.analysis.orbits.switching_flow import SwitchingFlow, any_flow
from lagjax.analysis.orbits.switching_problem import any_problem_of, refuse_unfollowed
from lagjax.display import plots as plot
from lagjax.jaxtools import compiled, is_traced, numpy_of
from lagjax.system import Hybrid, State, System, by_name, coordinates

# Looser than for a cycle: averages over a motion that forgets its start do not depend on all its digits.
TOLERANCE = {np.dtype("float64"): 1e-9, np.dtype("float32"): 1e-5}
# The fraction of a motion in which the frame settles, the number of parts of the rest from which the spread is
# computed, and the smallest number of times.
SETTLING, BLOCKS, FEWEST = 0.25, 10, 24
# With switches, a tangent that shrinks by more than so many round-offs from one time to the next is lost.
LOST_BELOW = 1e3
# The uncertainty in standard deviations of the mean.
DEVIATIONS = 2.0
# The logarithm of the growth that may have happened once without being exponential.
SINGLE_GROWTH = np.log(10.0)


class LyapunovExponents(eqx.Module):
    """The largest Lyapunov exponents of a motion, and how uncertain they are. It prints and plots itself.

    - `exponents` (count,), `1/[t]`, in falling order to within their uncertainty; -inf for a direction in which
      neighbours meet, as where something sticks.
    - `uncertainty` (count,), `1/[t]`: the root sum of squares of twice the standard deviation of the mean, the change
      if only the later half is used, and the effect of one growth by a factor of ten.
    - `t` (T,): the times, `[t]`. `growth` (T-1, count): the logarithm of the growth from each time to the next.
    - `volume` (T-1,): the logarithm of the growth of the volume by Liouville's formula if all exponents were requested,
      else 0; NaN for a motion with switches.
    - `settled`: the time from which growth is counted.
    - `ended`: whether the motion could be followed to its end; if not, the exponents are NaN.

    Growth is that of the motion over a whole interval, whatever happens inside it. Under `vmap` every array has the
    batch's axes in front.
    """

    exponents: Float[Array, " count"]
    uncertainty: Float[Array, " count"]
    t: Float[Array, " T"]
    growth: Float[Array, "T-1 count"]
    volume: Float[Array, " T-1"]
    settled: Float[Array, ""]
    ended: Bool[Array, ""]
    all_of_them: bool = eqx.field(static=True)

    @property
    def sensitive(self) -> Bool[Array, ""]:
        """Whether neighbours separate exponentially: the largest exponent exceeds zero by more than its uncertainty."""
        return self.exponents[..., 0] > self.uncertainty[..., 0]

    @property
    def liouville(self) -> Float[Array, ""]:
        """The sum of all exponents by Liouville's formula; NaN unless all were requested."""
        first = _first_counted(self.t.shape[-1])
        mean = jnp.sum(self.volume[..., first:], axis=-1) / (self.t[..., -1] - self.t[..., first])
        return mean if self.all_of_them else jnp.full_like(mean, jnp.nan)

    def running(self) -> Float[Array, "T-1 count"]:
        """The mean growth from the first time to each of the others, which shows whether the exponents settle."""
        return jnp.cumsum(self.growth, axis=-2) / (self.t[..., 1:] - self.t[..., :1])[..., None]

    def plot(self):
        """Plot the running means against time; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib; `ValueError` for a batch.
        """
        if np.ndim(self.settled):
            raise ValueError(
                f"these are exponents of a batch of shape {np.shape(self.settled)}: draw one lane of it.\n"
                "Fix: jax.tree.map(lambda x: x[0], found).plot()"
            )
        curves = {f"λ{i + 1}": curve for i, curve in enumerate(np.asarray(self.running()).T)}
        return plot.time_series(np.asarray(self.t)[1:], {"mean growth": curves})

    def __repr__(self):
        if is_traced(self):
            return f"LyapunovExponents(being traced, {self.exponents.shape[-1]} of them)"
        if np.ndim(self.settled):
            lanes, parting = " x ".join(map(str, np.shape(self.settled))), int(np.sum(np.asarray(self.sensitive)))
            return f"Lyapunov exponents of {lanes} lanes; neighbours part in {parting} of them"
        pairs = zip(np.asarray(self.exponents), np.asarray(self.uncertainty))
        rows = [("exponents", ", ".join(f"{x:.4g} ± {u:.1g}" if x > -np.inf else "-inf" for x, u in pairs))]
        rows.append(("of growth", f"from t = {float(self.settled):.6g} to {float(self.t[-1]):.6g}"))
        if not np.all(np.asarray(self.exponents) > -np.inf):
            rows.append(("-inf", "neighbours meet, as where something sticks, or is struck without restitution"))
        elif self.all_of_them and np.isfinite(float(self.liouville)):
            total = float(jnp.sum(self.exponents))
            rows.append(("sum", f"{total:.6g}; by Liouville's formula {float(self.liouville):.6g}"))
        parts = "neighbours part exponentially; chaos, if the motion stays bounded"
        verdict = parts if bool(self.sensitive) else "no exponential parting seen in this time"
        rows.append(("verdict", verdict if bool(self.ended) else "not known: the motion could not be followed"))
        return "\n".join(["Lyapunov exponents", *(f"  {label:<9}  {value}" for label, value in rows)])


@by_name("lj.lyapunov_exponents(system, q, v, params, ts=ts)", "ts")
def lyapunov_exponents(
    system: System | Hybrid,
    q: PyTree[ArrayLike],
    v: PyTree[ArrayLike],
    params: PyTree = None,
    *,
    ts: ArrayLike,
    count: int = 1,
    rtol: ArrayLike | None = None,
    phase: str | int | None = None,
) -> LyapunovExponents:
    """Return the largest Lyapunov exponents of a motion, with their uncertainty.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> hill = lj.System(lambda t, q, v, params: 0.5 * v**2 + 0.5 * params["k"] * q**2)
    >>> found = lyapunov_exponents(hill, 0.0, 0.0, {"k": 4.0}, ts=jnp.linspace(0.0, 40.0, 41), count=2)
    >>> print(found.exponents.round(6), bool(found.sensitive))
    [ 2. -2.] True

    **Arguments:**

    - `system`, `q`, `v`, `params`: as in `lj.integrate`; the system may have elements, or be a `Hybrid`. The state is
      moved to the nearest one that satisfies the constraints.
    - `ts` (T,): increasing times, `[t]`, at which the tangents are made orthonormal again, close enough that they do
      not grow by more than about 1e6 in between. In the first quarter of them the directions settle.
    - `count`: how many exponents; at most twice the number of coordinates, minus what constraints take away, and with
      states counted once.
    - `rtol`: the tolerance of the steps; 1e-9 by default in float64, 1e-5 in float32.
    - `phase`: the phase of a `Hybrid` at the start, by name or number; by default the first one.

    **Returns:** a `LyapunovExponents`.

    **Raises:** `TypeError`, `ValueError` for a state of the wrong shape or dtype; `ValueError` for fewer than 24 times
    or times out of order, and for more exponents than there are.

    Source: Benettin et al., *Meccanica* 15 (1980) 21.
    """
    ts = numpy_of(ts).asarray(ts)
    _check(ts)
    problem = any_problem_of(system, State(ts[0], q, v, params), phase)
    s = coordinates.state(*problem.state)
    most = any_flow(problem.system, s, 1.0, problem.rows).dimension
    if not (isinstance(count, int) and 1 <= count <= most):
        raise ValueError(
            f"count must be between 1 and {most}, not {count!r}: the state space has {most} directions.\n"
            f"Fix: count={most} for all of them."
        )
    rtol = np.asarray(TOLERANCE.get(np.dtype(s.t.dtype), 1e-5) if rtol is None else rtol, s.t.dtype)
    estimates = _followed(problem.system, s, ts.astype(s.t.dtype), rtol, problem.rows, count)
    exponents = LyapunovExponents(*estimates, count == most)
    if not is_traced(exponents) and not bool(exponents.ended):
        refuse_unfollowed(problem, float(ts[-1] - ts[0]))
    return exponents


def _check(ts):
    if ts.ndim != 1 or len(ts) < FEWEST:
        raise ValueError(
            f"ts must be a vector of at least {FEWEST} times, and has shape {ts.shape}.\n"
            "Usual cause: only the end time; between two distant times the fastest-growing tangent hides all others.\n"
            "Fix: ts=jnp.linspace(0.0, 1000.0, 1001)."
        )
    if not is_traced(ts) and not np.all(np.asarray(ts[1:] > ts[:-1])):
        raise ValueError("ts must increase throughout.\nFix: ts=jnp.unique(ts).")


@compiled
def _followed(system, s, ts, rtol, rows, count):
    flow, t = any_flow(system, s, rtol, rows), s.t
    z = flow.vector(s.q, s.v)
    scale = _scale(flow.start, t, z)
    z = flow.onto_constraints(t, z, scale)
    basis = flow.tangent_space(t, z, scale)
    # Generic directions, the same at each call.
    chosen = np.random.default_rng(0).normal(size=(basis.shape[1], count)).astype(basis.dtype)
    frame, _ = _orthonormal(basis @ chosen)

    def onward(state, times):
        z, frame, ended, phase = state
        t, t1 = times
        if isinstance(flow, SwitchingFlow):
            passed = flow.passage(t, z, t1 - t, frame, scale, phase=phase)
            frame, growth = _orthonormal(passed.frame, LOST_BELOW * jnp.finfo(z.dtype).eps)
            return (passed.z, frame, ended & passed.ended, passed.phase), (growth, passed.growth)
        passed = flow.passage(t, z, t1 - t, frame, scale, volume=count == basis.shape[1])
        z = flow.onto_constraints(t1, passed.z, scale)
        frame = passed.frame
        if flow.dimension < z.size:
            basis_there = flow.tangent_space(t1, z, scale)
            frame = basis_there @ (basis_there.T @ frame)
        frame, growth = _orthonormal(frame)
        return (z, frame, ended & passed.ended, phase), (growth, passed.growth)

    # The phase is known only in the motion.
    phase = jnp.asarray(flow.system.first, jnp.int32) if isinstance(flow, SwitchingFlow) else None
    (_, _, ended, _), (growth, volume) = lax.scan(onward, (z, frame, jnp.asarray(True), phase), (ts[:-1], ts[1:]))
    exponents, uncertainty = _estimates(ts, growth)
    ended = ended & ~jnp.any(jnp.isnan(growth) | (growth == jnp.inf))
    exponents, uncertainty = (jnp.where(ended, x, jnp.nan) for x in (exponents, uncertainty))
    return exponents, uncertainty, ts, growth, volume, ts[_first_counted(len(ts))], ended


def _orthonormal(frame, lost_below=0.0):
    """Q of Y = Q R, and the logarithms of the diagonal entries of R; -inf for one that is lost."""
    q, r = jnp.linalg.qr(frame)
    size = jnp.abs(jnp.diagonal(r))
    return q, jnp.log(jnp.where(size <= lost_below * jnp.maximum(1.0, jnp.max(size)), 0.0, size))


def _first_counted(count):
    """The index of the time from which growth is counted."""
    return int(SETTLING * (count - 1))


def _estimates(ts, growth):
    first = _first_counted(len(ts))
    lost = jnp.any(growth[first:] == -jnp.inf, axis=0)
    growth = jnp.where(growth == -jnp.inf, 0.0, growth)

    def mean(a: int, b: int):
        return jnp.sum(growth[a:b], axis=0) / (ts[b] - ts[a])

    edges = np.linspace(first, len(ts) - 1, BLOCKS + 1).astype(int)
    blocks = jnp.stack([mean(a, b) for a, b in zip(edges[:-1], edges[1:])])
    spread = DEVIATIONS * jnp.std(blocks, axis=0, ddof=1) / np.sqrt(BLOCKS)
    middle, last = edges[BLOCKS // 2], len(ts) - 1
    later = mean(middle, last) - mean(first, last)
    single = SINGLE_GROWTH / (ts[last] - ts[first])
    uncertainty = jnp.sqrt(spread**2 + later**2 + single**2)
    return jnp.where(lost, -jnp.inf, mean(first, last)), jnp.where(lost, 0.0, uncertainty)


def _scale(flow, t, z):
    """Sizes of coordinates and velocities, from the state and how fast it changes; never zero."""
    x, u = jnp.split(jnp.abs(lax.stop_gradient(z)), 2)
    a = jnp.abs(lax.stop_gradient(flow.rate(t, z)))[flow.size :]
    of_x, of_u, of_a = (jnp.max(y) for y in (x, u, a))
    of_x = jnp.where(of_x > 0, of_x, 1.0)
    rate = jnp.maximum(of_u / of_x, jnp.sqrt(of_a / of_x))
    rate = jnp.where(rate > 0, rate, 1.0)
    size = jnp.maximum(x, u / rate)
    largest = jnp.max(size)
    size = jnp.where(size > 1e-3 * largest, size, jnp.where(largest > 0, largest, 1.0))
    return jnp.concatenate([size, size * rate])
