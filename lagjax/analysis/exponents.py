"""Floquet multipliers: how small departures from a periodic motion grow or decay in a period.

When a motion comes back after a period T, its tangents have been multiplied by the monodromy matrix M, and after k
periods by M^k. The eigenvalues μ of M are the multipliers, σ = log(μ)/T the exponents. In coordinates of the tangent
space of the constraints their product is known without M, by Liouville's formula,

    ∏ μ = exp ∮ tr P J dt,

which is 1 for a Lagrangian without damping, and e^(-cT) for damping -c v of unit masses. The two are computed
independently, and their difference is reported. A motion is linearly stable if no |μ| is above 1.

A loss of stability is classified by where a multiplier leaves the unit circle: at +1 (a fold, a loss of symmetry), at
-1 (a motion of twice the period begins), or as a complex pair between.

Source: Coddington & Levinson, *Theory of ODEs*, §3.5; Guckenheimer & Holmes, *Nonlinear Oscillations*, §1.5 and §3.5.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from lagjax.analysis.orbits.monodromy import period_of
from lagjax.analysis.orbits.result import PeriodicOrbit
from lagjax.analysis.orbits.switching_problem import any_problem_of, refuse_unfollowed
from lagjax.display import plots
from lagjax.jaxtools import is_traced
from lagjax.system import Hybrid, State, System

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
        return "\n".join(["Floquet multipliers", *(f"  {label:<11}  {value}" for label, value in rows)])


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
    if not isinstance(orbit, PeriodicOrbit):
        raise TypeError(
            f"floquet needs a lj.System or a periodic orbit, not {type(orbit).__name__}.\n"
            "Fix: lj.floquet(system, t, q, v, params, period), or lj.floquet(orbit) of a lj.periodic_orbit."
        )
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
