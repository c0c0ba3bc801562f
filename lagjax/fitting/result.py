"""The answer of a fit: estimates, how certain they are, and whether the residuals look like measurement errors."""

import os
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree

from lagjax import plot
from lagjax.fitting.equations import LOSSES, WHOLE, Problem, dampened, equations, starts_at
from lagjax.fitting.identifiability import Identifiability
from lagjax.fitting.laplace import Laplace, laplace
from lagjax.fitting.misfit import Misfit
from lagjax.fitting.records import channel_name
from lagjax.fitting.saving import save
from lagjax.fitting.search import Evaluation
from lagjax.fitting.table import lines_of
from lagjax.mechanics import coordinates
from lagjax.mechanics.compiled import compiled
from lagjax.mechanics.diagnosis import listed
from lagjax.mechanics.signature import UnknownSystem
from lagjax.motion.integrate import integrate
from lagjax.motion.reported import Report
from lagjax.motion.results import RESULTS
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


# No module of equinox: that wraps a method each time it is looked up.
@jtu.register_dataclass
@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Estimates from measured motion. It prints itself as a table and plots data, fit and residuals.

    - `params`: with the estimates in place. `q0`, `v0`: the start of each record, a list.
    - `names`, `values`, `sd` (p,): the numbers found, and their standard deviations; NaN where the data do not
      determine one. With `sigma` given they follow from it, else from the residuals.
    - `covariance`, `correlation` (p, p).
    - `start_sd`: standard deviations of `q0` and `v0`, as two lists of pytrees; 0 of what was held, NaN of what the
      data do not determine.
    - `identifiability`: which combinations the data see. `laplace()`: a normal distribution by the true second
      derivatives. `log_likelihood`, `log_posterior`: for samplers.
    - `chi2`, `freedom`: the sum of squared residuals in sigmas (of the unit that is estimated, without sigmas), and the
      number of measurements less that of unknowns. `noise`: the estimated sigma, where none was given.
    - `result`: a `RESULTS` item: `lj.RESULTS.successful`, `not_converged` or `misfit`. `converged`: whether it is the
      first: the search came to rest, and the residuals neither contradict `sigma` nor follow a curve.
    - Arrays are NumPy's, but where the fit is part of a program.
    - `steps`, `cost`: of the search. `costs`: from each start, the guess first; NaN where none was needed.
    - `training`: how an optimiser of optax went, `found.training.plot()`, and what was held back.
    """

    problem: Problem
    unknowns: Unknowns
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    rested: Bool[Array, ""]
    misfit: Misfit
    costs: Float[Array, " starts"]
    evaluation: Evaluation | None
    units: tuple[tuple[str, str], ...] = eqx.field(static=True)
    training: Any = None

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
        return [q for q, _ in self.starts()]

    @property
    def v0(self) -> list[PyTree]:
        return [v for _, v in self.starts()]

    @property
    def result(self) -> RESULTS:
        if not self._traced:
            ended = RESULTS.misfit if np.any(self.misfit.any) else RESULTS.successful
            return cast(RESULTS, ended if self.rested else RESULTS.not_converged)
        ended = RESULTS.where(self.misfit.any, RESULTS.misfit, RESULTS.successful)
        return RESULTS.where(self.rested, ended, RESULTS.not_converged)

    @property
    def converged(self) -> Bool[Array, ""]:
        return self.rested & ~self.misfit.any

    @property
    def _traced(self) -> bool:
        return coordinates.is_traced((self.cost, self.unknowns))

    @property
    def _xp(self) -> Any:
        """What to compute with: NumPy compiles nothing."""
        return jnp if self._traced else np

    def report(self) -> Report:
        """How it went, for a sweep's status."""
        nothing = jnp.zeros_like(self.cost)
        return Report(self.result._value, self.steps, nothing, nothing)

    @property
    def determined(self) -> Bool[Array, " p"]:
        return self._evaluated().determined.shared

    @property
    def identifiability(self) -> Identifiability:
        evaluation = self._evaluated()
        noise = self._xp.sqrt(self.variance)
        return Identifiability(self.names, self.values, evaluation.singular_values, evaluation.combinations, noise)

    @property
    def chi2(self) -> Float[Array, ""]:
        return 2 * self.cost if self.evaluation is None else self.evaluation.chi2

    @property
    def freedom(self) -> Float[Array, ""]:
        return self._evaluated().freedom

    @property
    def variance(self) -> Float[Array, ""]:
        """The variance of an error in sigmas: 1 where sigmas were given."""
        xp = self._xp
        if self.problem.absolute:
            return xp.ones_like(self.chi2)
        # Of as many numbers as measurements nothing is left over to tell the size of an error by.
        return xp.where(self.freedom > 0, self.chi2 / xp.maximum(self.freedom, 1), np.nan)

    @property
    def noise(self) -> Float[Array, ""]:
        """The size of a measurement error: 1, in sigmas, where these were given; else estimated, in the data's unit."""
        first = jax.tree.leaves(self.problem.sigma)[0]
        xp = self._xp
        return xp.sqrt(self.variance) * (1.0 if self.problem.absolute else xp.nanmax(first))

    @property
    def covariance(self) -> Float[Array, "p p"]:
        known = self.determined[:, None] & self.determined[None, :]
        return self._xp.where(known, self._of_errors() * self._evaluated().covariance.shared, np.nan)

    @property
    def sd(self) -> Float[Array, " p"]:
        return self._xp.sqrt(self._xp.diag(self.covariance))

    @property
    def correlation(self) -> Float[Array, "p p"]:
        sd = self.sd
        with np.errstate(divide="ignore", invalid="ignore"):
            return self.covariance / (sd[:, None] * sd[None, :])

    @property
    def start_sd(self) -> tuple[list[PyTree], list[PyTree]]:
        # On constraints a start depends on the parameters too: that of a rod of unknown length, for example.
        xp, evaluation, windows = self._xp, self._evaluated(), self.problem.windows.first
        of, determined, of_errors = evaluation.covariance, evaluation.determined, self._of_errors()
        _, slopes = self.known_starts()
        found = []
        for r, w in enumerate(windows):
            joint = of_errors * xp.block([[of.shared, of.local_shared[w].T], [of.local_shared[w], of.local[w]]])
            known = xp.concatenate([determined.shared, determined.local[w]])

            def sd(slopes, r=r, joint=joint, known=known):
                with np.errstate(invalid="ignore"):
                    variance = xp.einsum("...i,ij,...j", slopes[r], joint, slopes[r])
                unknown = xp.any(xp.where(known, 0.0, slopes[r]) != 0, axis=-1)
                return xp.where(unknown, np.nan, xp.sqrt(xp.maximum(variance, 0.0)))

            found.append(jax.tree.map(sd, slopes))
        of_q, of_v = zip(*found)
        return list(of_q), list(of_v)

    def _evaluated(self) -> Evaluation:
        if self.evaluation is None:
            raise ValueError(
                f"uncertainties of {len(self.names)} numbers are not computed.\n"
                "Fix: fit fewer of them: freeze a network with free=[...]."
            )
        return self.evaluation

    def _of_errors(self):
        """The variance of an M-estimate of many measurements, in units of that of least squares with these sigmas."""
        if self.problem.loss == "squares":
            return self.variance
        return _of_forgiven_errors(self._evaluated().rows.reshape(-1), self.known(), self.problem.loss)

    def known(self) -> Bool[Array, " windows*m"]:
        """Which of the residuals `evaluation.rows`, in a row, belong to a measurement."""
        parts = []
        for kind, tree in self.problem.measured.items():
            for x, s in zip(jax.tree.leaves(tree), jax.tree.leaves(self.problem.sigma[kind])):
                xp: Any = coordinates.numpy_of((x, s))
                known = xp.isfinite(x) & xp.isfinite(s)
                parts.append(known.reshape(known.shape[0], -1))
        by_window: Any = coordinates.numpy_of(parts).concatenate(parts, axis=1)
        return by_window.reshape(-1)

    def starts(self) -> list[tuple[PyTree, PyTree]]:
        """(q, v) at the start of each record."""
        states, _ = self.known_starts()
        return [jax.tree.map(lambda x, r=r: x[r], states) for r in range(len(self.problem.windows.first))]

    def known_starts(self) -> tuple[PyTree, PyTree]:
        """The starts of all records together, and their slopes by the unknowns."""
        system = self.problem.system
        if isinstance(system, UnknownSystem):
            return system.starts
        return starts_at(self.problem, self.unknowns, self.problem.windows.first)

    def motion(self, record: int = 0, ts=None) -> Trajectory:
        """The fitted motion of a record from its start, at its times or at others from the same start."""
        windows = np.flatnonzero(np.asarray(self.problem.windows.record) == record)
        params, (q, v) = self.problem.params(self.unknowns.shared, int(windows[0])), self.starts()[record]
        if ts is None:
            real = np.asarray(self.problem.windows.real)
            ts = np.concatenate([np.asarray(self.problem.windows.ts)[i][real[i]] for i in windows])
        return integrate(self.problem.system, q, v, params, ts=ts, **({"throw": False} | self.problem.options))

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
        rows = _rows(self.problem, self.unknowns) if self.evaluation is None else self.evaluation.rows
        for kind, tree in self.problem.measured.items():
            sigmas = jax.tree.leaves(self.problem.sigma[kind])
            for (path, x), sigma in zip(jax.tree_util.tree_leaves_with_path(tree), sigmas):
                x, size = np.asarray(x), int(np.prod(x.shape[1:]))
                r = np.asarray(rows[:, at : at + size]).reshape(x.shape) * np.asarray(sigma)
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
        # JAX's arrays, for a sampler.
        of_names = {name: jnp.asarray(self.unknowns.shared[i]) for i, name in enumerate(self.names)}
        return of_names | {"starts": jnp.asarray(self.unknowns.local)}

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

    @property
    def log_posterior(self) -> Callable[[Mapping[str, Array]], Float[Array, ""]]:
        """`log_likelihood` with the fit's priors, up to a constant."""
        found, likelihood = self.problem.found, self.log_likelihood

        def density(unknowns):
            known = self.sampling | dict(unknowns)
            off = [(known[name] - found.mean[i]) / found.sd[i] for i, name in enumerate(self.names)]
            return likelihood(unknowns) - 0.5 * sum((jnp.asarray(x) ** 2 for x in off), jnp.zeros(()))

        return density

    def laplace(self) -> Laplace:
        """The normal distribution with the peak and the true second derivatives of `log_posterior`, and its evidence.

        It says where these differ from those of `covariance`, and where there is no peak (with an `lj.FitWarning`).

        **Raises:** `ValueError` for joined windows, whose starts are no unknowns; `TypeError` where the fit is traced.
        """
        if self._traced:
            raise TypeError("laplace() looks at numbers, and this fit is traced.\nFix: call it outside of the program.")
        evaluation = self._evaluated()
        priors = np.isfinite(self.problem.found.sd).sum()
        apart = self.known().sum() + priors - sum(np.sum(d) for d in evaluation.determined)
        # A seam takes away an unknown: it shows in the freedom.
        if self.freedom > apart + 0.5:
            raise ValueError(
                "the windows of this fit are joined, and log_likelihood has each with a start of its own.\n"
                "Fix: lj.fit(system, records, found.params), without window=, from what was found."
            )
        found = laplace(self.problem, self.unknowns, float(self.variance))
        if not found.positive_definite:
            warnings.warn(f"Laplace: {found.caveats[0]}", FitWarning, stacklevel=2)
        return found

    def at_bounds(self) -> list[str]:
        """The names of numbers that ended at a bound."""
        found, x = self.problem.found, np.asarray(self.values)
        low, high = np.asarray(found.low), np.asarray(found.high)
        size = np.maximum(np.abs(np.asarray(found.start)), 1e-300)
        near = (x - low < AT_BOUND * size) | (high - x < AT_BOUND * size)
        return [name for name, at in zip(self.names, near) if at]

    def save(self, path: str | os.PathLike) -> None:
        """Write the fit into a file, an npz; `lj.load_fit(path, system)` reads it, bit for bit.

        Functions are not in it: the system, `observe`, and options that hold some. Whoever is stopped while it is
        written leaves the file of before.

        **Raises:** `TypeError` for what is no data in `params`, by name; `OSError` where there is no such folder.
        """
        save(self, path)

    def plot(self, record: int = 0):
        """Draw data, fit and residuals of a record, a row each channel; returns a matplotlib `Figure`."""
        return plot.fits({name: rest for name, *rest in self.channels(record) if rest[0] is not None})

    def __repr__(self):
        if coordinates.is_traced(self.cost):
            return f"Fit of {listed(list(self.names))}, being traced"
        return "\n".join(lines_of(self) + ([] if self.training is None else [repr(self.training)]))


@partial(compiled, in_numpy=True)
def _rows(problem: Problem, u: Unknowns):
    """The plain residuals of all windows."""
    return equations(replace(problem, loss="squares"), u, WHOLE).rows


@partial(compiled, in_numpy=True)
def _of_forgiven_errors(r, known, loss):
    """The variance of an M-estimate, Huber, Robust Statistics, Eq. (7.6.2)."""
    constant, _ = LOSSES[loss]
    half = lambda r: 0.5 * dampened(r, loss) ** 2
    slope = jax.vmap(jax.grad(half))
    curvature = jax.vmap(jax.grad(jax.grad(half)))
    r = jnp.where(r == 0, constant * 1e-9, r)
    mean = lambda x: jnp.sum(jnp.where(known, x, 0.0)) / jnp.sum(known)
    return mean(slope(r) ** 2) / mean(curvature(r)) ** 2
