"""The answer of a fit: estimates, how certain they are, and whether the residuals look like measurement errors."""

from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax import plot
from lagjax.fitting.equations import LOSSES, WHOLE, Problem, dampened, equations
from lagjax.fitting.identifiability import Identifiability
from lagjax.fitting.records import channel_name
from lagjax.fitting.search import Seen
from lagjax.mechanics import coordinates
from lagjax.mechanics.diagnosis import listed
from lagjax.motion.integrate import integrate
from lagjax.motion.trajectory import Trajectory
from lagjax.numerics.chained import Unknowns

# A number that is closer to its bound than this, relative to the bound's size, or its start's, is at it.
AT_BOUND = 1e-6


class FitWarning(UserWarning):
    """A fit has an answer, and there is something to know about it."""


class Channel(NamedTuple):
    """A kind of measurement: its name, times (T,) (None for ends), what was measured and residuals, (T, ...)."""

    name: str
    t: np.ndarray | None
    measured: np.ndarray
    residuals: np.ndarray


class Fit(eqx.Module):
    """Estimates from measured motion. It prints itself as a table and plots data, fit and residuals.

    - `params`: with the estimates in place. `q0`, `v0`: the start of each record, a list.
    - `names`, `values`, `sd` (p,): the numbers found, and their standard deviations; NaN where the data do not
      determine one. With `sigma` given they follow from it, else from the residuals.
    - `covariance`, `correlation` (p, p).
    - `start_sd`: standard deviations of `q0` and `v0`, as two lists of pytrees; 0 of what was held, NaN of what the
      data do not determine.
    - `identifiability`: which combinations the data see.
    - `chi2`, `freedom`: the sum of squared residuals in sigmas (of the unit that is estimated, without sigmas), and the
      number of measurements less that of unknowns. `noise`: the estimated sigma, where none was given.
    - `converged`, `steps`, `cost`: of the search; `costs` of its restarts.
    """

    problem: Problem
    unknowns: Unknowns
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]
    costs: Float[Array, " starts"] | None
    seen: Seen | None
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)

    @property
    def names(self) -> tuple[str, ...]:
        return self.problem.found.names

    @property
    def values(self) -> Float[Array, " p"]:
        return self.unknowns.shared

    @property
    def params(self) -> PyTree:
        return self.problem.found.into(self.unknowns.shared)

    @property
    def q0(self) -> list[PyTree]:
        return [q for q, _ in self._starts()]

    @property
    def v0(self) -> list[PyTree]:
        return [v for _, v in self._starts()]

    @property
    def determined(self) -> Bool[Array, " p"]:
        return self._seen().determined.shared

    @property
    def identifiability(self) -> Identifiability:
        seen = self._seen()
        noise = jnp.sqrt(self.variance)
        return Identifiability(self.names, self.values, seen.singular_values, seen.combinations, noise)

    @property
    def chi2(self) -> Float[Array, ""]:
        return 2 * self.cost if self.seen is None else self.seen.chi2

    @property
    def freedom(self) -> Float[Array, ""]:
        return self._seen().freedom

    @property
    def variance(self) -> Float[Array, ""]:
        """The variance of an error in sigmas: 1 where sigmas were given."""
        if self.problem.absolute:
            return jnp.ones_like(self.chi2)
        # Of as many numbers as measurements nothing is left over to tell the size of an error by.
        return jnp.where(self.freedom > 0, self.chi2 / jnp.maximum(self.freedom, 1), jnp.nan)

    @property
    def noise(self) -> Float[Array, ""]:
        """The size of a measurement error: 1, in sigmas, where these were given; else estimated, in the data's unit."""
        first = jax.tree.leaves(self.problem.sigma)[0]
        return jnp.sqrt(self.variance) * (1.0 if self.problem.absolute else jnp.nanmax(first))

    @property
    def covariance(self) -> Float[Array, "p p"]:
        known = self.determined[:, None] & self.determined[None, :]
        return jnp.where(known, self._of_errors() * self._seen().covariance.shared, jnp.nan)

    @property
    def sd(self) -> Float[Array, " p"]:
        return jnp.sqrt(jnp.diag(self.covariance))

    @property
    def correlation(self) -> Float[Array, "p p"]:
        return self.covariance / (self.sd[:, None] * self.sd[None, :])

    @property
    def start_sd(self) -> tuple[list[PyTree], list[PyTree]]:
        # On constraints a start depends on the parameters too: that of a rod of unknown length, for example.
        problem, (shared, own), seen = self.problem, self.unknowns, self._seen()
        of, determined, of_errors = seen.covariance, seen.determined, self._of_errors()
        of_q, of_v = [], []
        for w in problem.windows.first:
            state = lambda both, w=w: problem.setting(both[: shared.size], both[shared.size :], w, WHOLE)[2]
            slopes = jax.jacfwd(state)(jnp.concatenate([shared, own[w]]))
            joint = jnp.block([[of.shared, of.own_shared[w].T], [of.own_shared[w], of.own[w]]])
            known = jnp.concatenate([determined.shared, determined.own[w]])

            def sd(slope, joint=of_errors * joint, known=known):
                variance = jnp.einsum("...i,ij,...j", slope, joint, slope)
                unknown = jnp.any(jnp.where(known, 0.0, slope) != 0, axis=-1)
                return jnp.where(unknown, jnp.nan, jnp.sqrt(jnp.maximum(variance, 0.0)))

            of_q.append(jax.tree.map(sd, slopes[0]))
            of_v.append(jax.tree.map(sd, slopes[1]))
        return of_q, of_v

    def _seen(self) -> Seen:
        if self.seen is None:
            raise ValueError(
                f"uncertainties and residuals of {len(self.names)} numbers are not computed.\n"
                "Fix: fit fewer of them: freeze a network with free=[...]."
            )
        return self.seen

    def _of_errors(self):
        """The variance of an M-estimate of many measurements, in units of that of least squares with these sigmas."""
        if self.problem.loss == "squares":
            return self.variance
        r = self._seen().rows.reshape(-1)
        constant, _ = LOSSES[self.problem.loss]
        half = lambda r: 0.5 * dampened(r, self.problem.loss) ** 2
        slope = jax.vmap(jax.grad(half))
        curvature = jax.vmap(jax.grad(jax.grad(half)))
        r = jnp.where(r == 0, constant * 1e-9, r)
        known = self.known()
        mean = lambda x: jnp.sum(jnp.where(known, x, 0.0)) / jnp.sum(known)
        # Huber, Robust Statistics, Eq. (7.6.2).
        return mean(slope(r) ** 2) / mean(curvature(r)) ** 2

    def known(self) -> Bool[Array, " windows*m"]:
        """Which of the residuals `seen.rows`, in a row, belong to a measurement."""
        parts = []
        for kind, tree in self.problem.measured.items():
            for x, s in zip(jax.tree.leaves(tree), jax.tree.leaves(self.problem.sigma[kind])):
                known = jnp.isfinite(x) & jnp.isfinite(s)
                parts.append(known.reshape(known.shape[0], -1))
        return jnp.concatenate(parts, axis=1).reshape(-1)

    def _starts(self):
        u = self.unknowns
        return [self.problem.setting(u.shared, u.own[w], w, WHOLE)[2] for w in self.problem.windows.first]

    def motion(self, record: int = 0, ts=None) -> Trajectory:
        """The fitted motion of a record from its start, at its times or at others from the same start."""
        windows = np.flatnonzero(np.asarray(self.problem.windows.record) == record)
        w = int(windows[0])
        times, params, (q, v), options = self.problem.setting(self.unknowns.shared, self.unknowns.own[w], w, WHOLE)
        if ts is None:
            real = np.asarray(self.problem.windows.real)
            ts = np.concatenate([np.asarray(self.problem.windows.ts)[i][real[i]] for i in windows])
        return integrate(self.problem.system, q, v, params, ts=ts, **({"throw": False} | options))

    def residuals(self, record: int | None = None) -> dict[str, np.ndarray]:
        """Predicted less measured, by channel, (T, ...) in the data's unit, NaN where nothing was measured.

        Of all records one after the other, or of one.
        """
        return {channel.name: channel.residuals for channel in self.channels(record)}

    def rms(self, record: int | None = None) -> dict[str, float]:
        """The root mean square of the residuals by channel, in the data's unit."""
        return {name: float(np.sqrt(np.nanmean(r**2))) for name, r in self.residuals(record).items()}

    def whiteness(self) -> dict[str, float]:
        """The correlation of each residual with the next by channel; of white ones it is 0 within 2/√(their number)."""
        found = {}
        for name, r in self.residuals().items():
            r = r.reshape(len(r), -1) / np.sqrt(np.nanmean(r**2))
            found[name] = float(np.nanmean(r[1:] * r[:-1])) if len(r) > 1 else np.nan
        return found

    def channels(self, record: int | None = None) -> Iterator[Channel]:
        """Each kind of measurement, of all records one after the other, or of one."""
        windows, at = self.problem.windows, 0
        chosen = np.asarray(windows.record) == (np.asarray(windows.record) if record is None else record)
        real = np.asarray(windows.real)[chosen]
        for kind, tree in self.problem.measured.items():
            sigmas = jax.tree.leaves(self.problem.sigma[kind])
            for (path, x), sigma in zip(jax.tree_util.tree_leaves_with_path(tree), sigmas):
                x, size = np.asarray(x), int(np.prod(x.shape[1:]))
                r = np.asarray(self._seen().rows[:, at : at + size]).reshape(x.shape) * np.asarray(sigma)
                r = np.where(np.isfinite(x), r, np.nan)
                at += size
                if kind == "end":
                    yield Channel(channel_name(kind, path), None, x[chosen], r[chosen])
                else:
                    t = np.asarray(windows.ts)[chosen][real]
                    yield Channel(channel_name(kind, path), t, x[chosen][real], r[chosen][real])

    @property
    def sampling(self) -> dict[str, Array]:
        """The unknowns as `log_likelihood` takes them: parameters by name, and the starts' deviations, (W, k)."""
        return dict(zip(self.names, self.unknowns.shared)) | {"starts": self.unknowns.own}

    @property
    def log_likelihood(self) -> Callable[[Mapping[str, Array]], Float[Array, ""]]:
        """A function: the logarithm of the probability density of the measurements, up to a constant; without priors.

        For samplers: differentiable, and can be jitted. It takes unknowns as in `sampling`; what is left out stays at
        its estimate. -inf outside the bounds, and where there is no motion.
        """
        found, variance = self.problem.found, self.variance

        def density(unknowns):
            known = self.sampling | dict(unknowns)
            x = jnp.stack([jnp.asarray(known[name]) for name in self.names] or [jnp.zeros(())])[: len(self.names)]
            values = equations(self.problem, Unknowns(x, jnp.asarray(known["starts"])), WHOLE)
            inside = jnp.all((x > found.low) & (x < found.high))
            fits = -0.5 * (jnp.sum(values.rows**2) + jnp.sum(values.seams**2)) / variance
            return jnp.where(inside & jnp.isfinite(fits), fits, -jnp.inf)

        return density

    def at_bounds(self) -> list[str]:
        """The names of numbers that ended at a bound."""
        found, x = self.problem.found, np.asarray(self.values)
        low, high = np.asarray(found.low), np.asarray(found.high)
        size = np.maximum(np.abs(np.asarray(found.start)), 1e-300)
        near = (x - low < AT_BOUND * size) | (high - x < AT_BOUND * size)
        return [name for name, at in zip(self.names, near) if at]

    def plot(self, record: int = 0):
        """Draw data, fit and residuals of a record, a row each channel; returns a matplotlib `Figure`."""
        return plot.fits({name: rest for name, *rest in self.channels(record) if rest[0] is not None})

    def __repr__(self):
        if coordinates.is_traced(self.cost):
            return f"Fit of {listed(list(self.names))}, being traced"
        return "\n".join(_lines(self))


def _lines(fit: Fit):
    how = "converged" if bool(fit.converged) else "NOT converged"
    windows = np.asarray(fit.problem.windows.record)
    lines = [f"Fit: {how} after {int(fit.steps)} steps"]
    if fit.costs is not None:
        near = int(np.sum(np.asarray(fit.costs) <= 1.01 * float(fit.cost) + 1e-300))
        lines[0] += f"; {near} of {len(fit.costs)} starts ended here"
    if fit.seen is None:
        lines.append(f"  {len(fit.names)} numbers, uncertainties not computed; cost {float(fit.cost):.6g}")
        return lines
    units, rows = dict(fit.units), []
    for name, x, sd in zip(fit.names, np.asarray(fit.values), np.asarray(fit.sd)):
        unit = units.get(name) or units.get(name.partition("[")[0], "")
        rows.append((name, _plus_minus(x, sd), unit))
    many = len(rows) > 40
    rows = rows[:40]
    starts = zip(fit.q0, fit.v0, *fit.start_sd)
    for r, (q, v, q_sd, v_sd) in enumerate(starts):
        if r < 4:
            of = f" of record {r}" if len(fit.q0) > 1 else ""
            for label, x, sd in (("", q, q_sd), ("v.", v, v_sd)):
                x, sd = (np.asarray(coordinates.flatten(y)[0]) for y in (x, sd))
                told = zip(coordinates.names(q), x, sd)
                rows += [(f"{label}{name}(0){of}", _plus_minus(a, b), "") for name, a, b in told if b != 0]
    width, wide = max(len(row[0]) for row in rows) if rows else 0, max((len(row[1]) for row in rows), default=0)
    lines += [f"  {name:<{width}}  {value:<{wide}}  {unit}".rstrip() for name, value, unit in rows]
    if many:
        lines.append(f"  ... and {len(fit.names) - 40} more")
    if windows.max() + 1 < len(windows):
        lines.append(f"  {len(windows)} windows, each from a start of its own")
    told = ", ".join(f"{name} {value:.3g}" for name, value in fit.rms().items())
    size = (
        f"chi2/freedom {float(fit.chi2 / fit.freedom):.3g}" if fit.problem.absolute else f"noise {float(fit.noise):.3g}"
    )
    lines.append(f"  residuals: rms {told}; {size}, {int(fit.freedom)} degrees of freedom")
    lines += _whiteness(fit)
    lines += ["  " + line for line in repr(fit.identifiability).splitlines()[1:]]
    if fit.at_bounds():
        lines.append(f"  at a bound: {listed(fit.at_bounds())}")
    return lines


def _whiteness(fit):
    lag, count = fit.whiteness(), int(np.sum(np.asarray(fit.known())))
    worst = max(lag, key=lambda name: abs(np.nan_to_num(lag[name])))
    if abs(np.nan_to_num(lag[worst])) < 3 / np.sqrt(max(count / len(lag), 1)):
        return []
    rho = min(lag[worst], 0.999)
    wider = np.sqrt((1 + rho) / (1 - rho)) if rho > 0 else 1.0
    words = f"  NOT white: residuals of {worst} correlate by {lag[worst]:.2f} with the next"
    return [words + (f"; the ± are about {wider:.1f} times too small" if wider > 1.1 else "")]


def _plus_minus(x, sd):
    if not np.isfinite(sd):
        return f"{x:.6g} (not determined)"
    if sd == 0:
        return f"{x:.9g}"
    digits = max(0, int(np.floor(np.log10(abs(x) / sd))) + 2) if x else 2
    digits = min(max(digits, 2), 12)
    return f"{x:#.{digits}g} ± {sd:.2g}"
