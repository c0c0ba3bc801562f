"""How neighbouring motions separate: Floquet multipliers over a period, Lyapunov exponents in the long run.

**Floquet multipliers.** When a motion comes back after a period T, its tangents have been multiplied by the monodromy
matrix M, and after k periods by M^k. The eigenvalues μ of M are the multipliers, σ = log(μ)/T the exponents. In
coordinates of the tangent space of the constraints their product is known without M, by Liouville's formula,

    ∏ μ = exp ∮ tr P J dt,

which is 1 for a Lagrangian without damping, and e^(-cT) for damping -c v of unit masses. The two are computed
independently, and their difference is reported. A motion is linearly stable if no |μ| is above 1.

A loss of stability is classified by where a multiplier leaves the unit circle: at +1 (a fold, a loss of symmetry), at
-1 (a motion of twice the period begins), or as a complex pair between.

Source: Coddington & Levinson, *Theory of ODEs*, §3.5; Guckenheimer & Holmes, *Nonlinear Oscillations*, §1.5 and §3.5.

**Lyapunov exponents.** The flow carries a frame of tangents, which is repeatedly made orthonormal, Y = Q R. The
logarithms of the diagonal of R, divided by the elapsed time, are the rates at which tangents, areas, volumes grow;
their means are the exponents λ_1 ≥ λ_2 ≥ ... With constraints the tangents are those of the constraint manifold.

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
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, PyTree

from lagjax.analysis.flow import SwitchingFlow, any_flow
from lagjax.analysis.monodromy import any_problem_of, period_of, refuse_unfollowed
from lagjax.analysis.periodic_orbit import PeriodicOrbit
from lagjax.display import labelled, plots
from lagjax.display import plots as plot
from lagjax.jaxtools import compiled, is_traced, numpy_of
from lagjax.refusals import must, must_be, must_be_single, must_be_whole
from lagjax.system import Hybrid, State, System, by_name, coordinates

# The largest extent of the axes: beyond this the circle would be too small to see.
FAR = 4.0


def unit_circle(multipliers: np.ndarray, trivial: np.ndarray):
    """Draw multipliers (k,) as dots, trivial ones hollow, with the unit circle; returns a matplotlib `Figure`.

    Multipliers far outside are drawn at the edge, with their values.
    """
    fig, axes = plots.figure(size=(4.2, 4.0))
    axis, turn = axes[0, 0], np.linspace(0.0, 2 * np.pi, 361)
    axis.fill(np.cos(turn), np.sin(turn), color="0.93", zorder=0)
    axis.plot(np.cos(turn), np.sin(turn), color=plots.COLOURS[-1], linewidth=1.0)
    size = np.abs(multipliers)
    reach = 1.2 * min(FAR, max(1.0, size[np.isfinite(size)].max(initial=1.0)))
    shown = multipliers * np.minimum(1.0, 0.96 * reach / np.maximum(size, 1e-300))
    outside = size > 1 + 1e-6
    axis.plot(*_parts(trivial), "o", markersize=10, markerfacecolor="none", color=plots.COLOURS[-1], label="trivial")
    for which, colour, label in (
        (~outside, plots.COLOURS[0], "inside or on it"),
        (outside, plots.COLOURS[1], "outside"),
    ):
        if which.any():
            axis.plot(*_parts(shown[which]), "o", markersize=5, color=colour, label=label)
    for x, at, far in zip(multipliers, shown, size > reach):
        if far:
            axis.annotate(f"{x.real:.3g}" + (f" {x.imag:+.3g}i" if x.imag else ""), (at.real, at.imag), (0, 8),
                          textcoords="offset points", ha="center", fontsize=8, bbox=plots.ON_MARKS)  # fmt: skip
    axis.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", xlabel="Re μ", ylabel="Im μ")
    axis.legend(fontsize=8, frameon=False, loc="upper left")
    return fig


def _parts(numbers):
    return np.real(numbers), np.imag(numbers)


# Multipliers below so many errors of M may consist of these errors alone.
UNKNOWN_BELOW = 100.0


class Floquet(eqx.Module):
    """The multipliers of a cycle, and its stability; print it for a summary, `plot` draws it.

    - `multipliers` (k,): complex; first those that are 1 for a known reason, then by falling size. k is twice the
      number of coordinates minus the number of independent constraint equations (a holonomic one counts twice, because
      it constrains the velocity too); a state, or a massless coordinate of first order, counts once.
    - `trivial` (k,): whether a multiplier is 1 for a known reason; `reasons` (r,) says which of those in `words` apply.
    - `monodromy` (2n, 2n): M for displacements (q, v) in the order of their names, zero for those off the constraints.
      What a displacement says of the velocities of states is ignored: they are determined.
    - `log_volume`: the logarithm of Liouville's product, ∮ tr P J dt; NaN for a motion with switches.
    - `error`: the estimated error of the entries of M, in units in which the state has size 1; from a second, less
      accurate run if nothing is traced, else from Liouville's formula, or of the size of the tolerance where that is
      unknown. Multipliers that are not much larger than this are unknown.
    - `period`; `ended`: whether the motion could be followed through it; `apart`: how far it then is from its start, in
      units of the state, apart from whole turns and coordinates on which nothing depends.

    Under `vmap` every array has the batch's axes in front.
    """

    multipliers: Complex[Array, " k"]
    trivial: Bool[Array, " k"]
    reasons: Bool[Array, " r"]
    monodromy: Float[Array, "2n 2n"]
    log_volume: Float[Array, ""]
    error: Float[Array, ""]
    period: Float[Array, ""]
    ended: Bool[Array, ""]
    apart: Float[Array, ""]
    words: tuple[str, ...] = eqx.field(static=True)

    @property
    def exponents(self) -> Complex[Array, " k"]:
        """`log(μ)/T`, `1/[t]`; imaginary parts between -π/T and π/T."""
        return jnp.log(self.multipliers) / self.period[..., None]

    @property
    def product(self) -> Float[Array, ""]:
        """The product of the multipliers."""
        return jnp.real(jnp.prod(self.multipliers, axis=-1))

    @property
    def liouville(self) -> Float[Array, ""]:
        """What their product must be, by Liouville's formula."""
        return jnp.exp(self.log_volume)

    @property
    def largest(self) -> Float[Array, ""]:
        """The largest size of a multiplier that is not trivial; 0 where there is none."""
        return jnp.max(jnp.where(self.trivial, 0.0, jnp.abs(self.multipliers)), axis=-1, initial=0.0)

    @property
    def within(self) -> Float[Array, ""]:
        """The tolerance of |μ| = 1: a double root on the circle is off by the square root of the error."""
        return jnp.sqrt(jnp.maximum(self.error, 10 * jnp.finfo(self.period.dtype).eps))

    @property
    def comes_back(self) -> Bool[Array, ""]:
        """Whether the motion is back at its start after the period; else M's eigenvalues are not multipliers."""
        return self.ended & (self.apart <= jnp.finfo(self.period.dtype).eps ** (1 / 3))

    @property
    def stable(self) -> Bool[Array, ""]:
        """Whether no multiplier is outside the unit circle."""
        return self.comes_back & (self.largest <= 1 + self.within)

    @property
    def attracts(self) -> Bool[Array, ""]:
        """Whether all nontrivial multipliers are inside the unit circle: the cycle is asymptotically stable."""
        return self.comes_back & (self.largest < 1 - self.within)

    @property
    def verdict(self) -> str:
        """The stability in words; not for a batch."""
        if not bool(self.ended):
            return "not known: the motion could not be followed through a period"
        if not bool(self.comes_back):
            return f"not known: the motion does not come back, by {float(self.apart):.1g} of its size"
        outside = np.asarray(self.multipliers)[~np.asarray(self.trivial)]
        if bool(self.stable):
            if len(outside) and bool(self.attracts):
                return "asymptotically stable: all multipliers that are not trivial are inside the unit circle"
            return "linearly stable: no multiplier is outside the unit circle"
        worst = outside[np.argmax(np.abs(outside))]
        if abs(worst.imag) > float(self.within):
            return f"unstable: a pair of multipliers {_number(worst)} and its conjugate, outside the unit circle"
        if worst.real < 0:
            return f"unstable: a multiplier {_number(worst)} below -1; what grows has twice the period"
        return f"unstable: a multiplier {_number(worst)} above 1"

    def plot(self):
        """Plot the multipliers in the complex plane, with the unit circle; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib.
        """
        lanes = np.asarray(self.multipliers).reshape(-1, self.multipliers.shape[-1])
        trivial = np.asarray(self.trivial).reshape(lanes.shape)
        return unit_circle(lanes[~trivial], lanes[trivial])

    def __repr__(self):
        if is_traced(self):
            return f"Floquet(being traced, {self.multipliers.shape[-1]} multipliers)"
        if np.ndim(self.period):
            stable = int(np.sum(np.asarray(self.stable)))
            return (
                f"Floquet multipliers of {' x '.join(map(str, np.shape(self.period)))} lanes, {stable} of them stable"
            )
        rows = [("multipliers", ", ".join(_listed(self))), ("period", f"{float(self.period):.9g}")]
        rows.append(("verdict", self.verdict))
        product, liouville = f"{float(self.product):.9g}", float(self.liouville)
        if not np.isnan(liouville):
            off = abs(float(self.product) - liouville)
            product += f"; by Liouville's formula {liouville:.9g} (apart by {off:.0e})"
        rows.append(("product", product))
        rows.append(("error of M", f"{float(self.error):.0e} (estimated, in units of the state)"))
        unknown = int(np.sum(np.abs(np.asarray(self.multipliers)) <= UNKNOWN_BELOW * float(self.error)))
        are = "is" if unknown == 1 else "are"
        if unknown and np.isnan(liouville):
            rows.append(("zero", f"{unknown} of the multipliers {are} 0 within the errors of M, as after sticking"))
        elif unknown:
            rows.append(("WARNING", f"{unknown} of the multipliers {are} not known: as small as the errors of M"))
        return labelled("Floquet multipliers", rows)


def floquet(
    system, t=None, q: PyTree = None, v: PyTree = None, params: PyTree = None, period=None, *, rtol=None, phase=None
) -> Floquet:
    """Return the Floquet multipliers of a motion that comes back after a period.

    The motion is a periodic orbit, or a state known to come back, such as rest in a driven system:

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def swing(t, q, v, params):
    ...     return 0.5 * v**2 - 0.5 * (params["a"] - 2 * params["q"] * jnp.cos(2 * t)) * q**2
    >>> found = floquet(lj.System(swing), 0.0, 0.0, 0.0, {"a": 1.0, "q": 0.25}, jnp.pi)
    >>> print(found.multipliers.real.round(6), bool(found.stable))
    [-1.476792 -0.677143] False

    **Arguments:**

    - `system`: the result of `lj.periodic_orbit`, alone; or a `System`, which may have elements, or a `Hybrid`, and
    - `t`, `q`, `v`, `params`: its state at the start; `period`, after which it comes back, `[t]`. Angles that go
      around, and coordinates on which nothing depends, need not come back, only their velocities.
    - `phase`: the phase of a `Hybrid` at the start, by name or number; by default the first one.
    - `rtol`: the tolerance of the steps, for the motion and its tangents; 1e-12 by default in float64, 1e-5 in float32.

    **Returns:** a `Floquet`, differentiable in both modes by the state and `params`; a double multiplier has no
    derivative.

    **Raises:** `TypeError`, `ValueError` for a state of the wrong shape or dtype, for missing arguments, and for a
    state that does not come back (not while JAX is tracing).

    Source: Coddington & Levinson, *Theory of Ordinary Differential Equations*, §3.5.
    """
    if not isinstance(system, System | Hybrid):
        return _of_orbit(system, rtol, (t, q, v, params, period, phase))
    for name, given in (("t", t), ("q", q), ("v", v), ("period", period)):
        if given is None:
            raise TypeError(
                f"floquet needs {name} with a system.\n"
                "Fix: lj.floquet(system, t, q, v, params, period), or lj.floquet(orbit) of a lj.periodic_orbit."
            )
    problem = any_problem_of(system, State(t, q, v, params), phase)
    found, error = period_of(problem, period, rtol)
    result = _floquet_of(problem, found, error, period)
    if not is_traced(found) and not bool(found.ended):
        refuse_unfollowed(problem, float(period))
    if not is_traced(found) and bool(found.ended) and not bool(result.comes_back):
        raise ValueError(
            f"this state does not come back after period = {float(period):.9g}: it is off by {float(found.apart):.2g} "
            "of its size.\n"
            "Usual cause: a rounded start or period, or the period of a small motion used for a large one.\n"
            "Fix: orbit = lj.periodic_orbit(system, (q, v), period, params), and lj.floquet(orbit)."
        )
    return result


def _of_orbit(orbit, rtol, given):
    fix = "lj.floquet(system, t, q, v, params, period), or lj.floquet(orbit) of a lj.periodic_orbit"
    must_be(PeriodicOrbit, orbit, "the first argument of floquet must be a lj.System or a periodic orbit", fix)
    if any(x is not None for x in given):
        raise TypeError(
            "a periodic orbit already contains its state, parameters and period.\n"
            "Fix: lj.floquet(orbit) alone; for other parameters find their orbit first."
        )
    problem = any_problem_of(orbit.system, State(orbit.t, orbit.q, orbit.v, orbit.params))
    if problem.system.in_phases:
        problem = problem._replace(is_angle=orbit.asked.angles)
    found, error = period_of(problem, orbit.period, rtol, orbit.nodes)
    return _floquet_of(problem, found, error, orbit.period)


def _floquet_of(problem, found, error, period):
    period = jnp.asarray(period, found.log_volume.dtype)
    names = problem.reasons.names(problem.state.q)
    return Floquet(
        found.multipliers, found.trivial, found.reasons, found.monodromy, found.log_volume, error, period, found.ended,
        found.apart, names,
    )  # fmt: skip


def _number(x):
    return f"{x.real:.6g}" if x.imag == 0 else f"{x.real:.6g} {'+' if x.imag > 0 else '-'} {abs(x.imag):.6g}i"


def _listed(found):
    """The multipliers one by one in words, trivial ones with their reason, conjugate pairs once."""
    words = iter([word for word, there in zip(found.words, np.asarray(found.reasons)) if there])
    for x, trivial in zip(np.asarray(found.multipliers), np.asarray(found.trivial)):
        if trivial:
            yield f"1 ({next(words)})"
        elif abs(x.imag) <= 1e-12 * abs(x):
            yield f"{x.real:.9g}"
        elif x.imag > 0:
            yield f"{x.real:.9g} ± {x.imag:.9g}i"


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
        must_be_single(np.shape(self.settled), "this", "{found}.plot()")
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
        return labelled("Lyapunov exponents", rows)


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
    must_be_whole(count, "count", most=most, fix=f"count={most} for all directions of the state space")
    rtol = np.asarray(TOLERANCE.get(np.dtype(s.t.dtype), 1e-5) if rtol is None else rtol, s.t.dtype)
    estimates = _followed(problem.system, s, ts.astype(s.t.dtype), rtol, problem.rows, count)
    exponents = LyapunovExponents(*estimates, count == most)
    if not is_traced(exponents) and not bool(exponents.ended):
        refuse_unfollowed(problem, float(ts[-1] - ts[0]))
    return exponents


def _check(ts):
    cause = "only the end time; between two distant times the fastest-growing tangent hides all others"
    well, claim = ts.ndim == 1 and len(ts) >= FEWEST, f"ts must be a vector of at least {FEWEST} times"
    must(well, claim, ts, "ts=jnp.linspace(0.0, 1000.0, 1001)", cause)
    must(is_traced(ts) or np.all(np.asarray(ts[1:] > ts[:-1])), "ts must increase throughout", ts, "ts=jnp.unique(ts)")


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
