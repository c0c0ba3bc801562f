"""The result of a fit: estimates, uncertainties, whether residuals look like measurement errors; table, warnings.

A file of a fit holds everything except functions; a signature identifies those of the system.
"""

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
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from lagjax.display import by_line, columns
from lagjax.display import plots as plot
from lagjax.files import NotGiven, NotWritable, Writer, npz
from lagjax.fit.arguments import FitWarning
from lagjax.fit.records import channel_name
from lagjax.fit.residuals import LOSSES, WHOLE, FitProblem, dampened, equations, starts_at
from lagjax.fit.search import Evaluation, Misfit
from lagjax.fit.uncertainty import Identifiability, Laplace, laplace, rank_of
from lagjax.integrate import RESULTS, Report, Trajectory, integrate
from lagjax.jaxtools import compiled, is_traced, numpy_of
from lagjax.mechanics import listed
from lagjax.numerics import Unknowns
from lagjax.refusals import must_have_values
from lagjax.system import State, UnknownSystem, coordinates, signature


def lines_of(fit: "Fit") -> list[str]:
    """The lines of a fit's table."""
    how = "converged" if bool(fit.rested) else "NOT converged"
    how += ", but the residuals are NOT measurement errors," if bool(fit.misfit.any) else ""
    windows = np.asarray(fit.problem.windows.record)
    lines = [f"Fit: {how} after {int(fit.steps)} steps"]
    tried = int(np.sum(np.isfinite(fit.costs)))
    if tried > 1:
        near = int(np.sum(np.asarray(fit.costs) <= 1.01 * float(fit.cost) + 1e-300))
        lines[0] += f"; {near} of {tried} starts ended here"
    if fit.evaluation is None:
        lines.append(f"  {len(fit.names)} numbers, uncertainties not computed; cost {float(fit.cost):.6g}")
        return lines
    units, rows = dict(fit.units), []
    for name, x, sd in zip(fit.names, np.asarray(fit.values), np.asarray(fit.sd)):
        unit = units.get(name) or units.get(name.partition("[")[0], "")
        rows.append((name, _plus_minus(x, sd), unit))
    many = len(rows) > 40
    rows = rows[:40]
    starts = fit.starts()
    for r, ((q, v), q_sd, v_sd) in enumerate(zip(starts, *fit.start_sd)):
        if r < 4:
            suffix = f" of record {r}" if len(starts) > 1 else ""
            for label, x, sd in (("", q, q_sd), ("v.", v, v_sd)):
                x, sd = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(y)]) for y in (x, sd))
                named = zip(coordinates.names(q), x, sd)
                rows += [(f"{label}{name}(0){suffix}", _plus_minus(a, b), "") for name, a, b in named if b != 0]
    lines += [f"  {line}" for line in columns(rows, "<")]
    if many:
        lines.append(f"  ... and {len(fit.names) - 40} more")
    if weak := fit.problem.found.weak:
        none = ", ".join(f'"{name}": None' for name in weak)
        lines.append(
            f"  weak priors about their guesses for the weights of {listed(list(weak))}; none: priors={{{none}}}"
        )
    if windows.max() + 1 < len(windows):
        lines.append(f"  {len(windows)} windows, each from a start of its own")
    rms = ", ".join(f"{name} {value:.3g}" for name, value in fit.rms().items())
    size = (
        f"chi2/freedom {float(fit.chi2 / fit.freedom):.3g}" if fit.problem.absolute else f"noise {float(fit.noise):.3g}"
    )
    lines.append(f"  residuals: rms {rms}; {size}, {int(fit.freedom)} degrees of freedom")
    lines += _whiteness(fit)
    lines += ["  " + line for line in (repr(fit.identifiability) if fit.names else "").splitlines()[1:]]
    if at := fit.at_bounds():
        lines.append(f"  at a bound: {listed(at)}")
    return lines


def _whiteness(fit: "Fit"):
    lag, count = fit.whiteness(), int(np.sum(np.asarray(fit.known())))
    worst = max(lag, key=lambda name: abs(np.nan_to_num(lag[name])))
    if abs(np.nan_to_num(lag[worst])) < 3 / np.sqrt(max(count / len(lag), 1)):
        return []
    rho = min(lag[worst], 0.999)
    wider = np.sqrt((1 + rho) / (1 - rho)) if rho > 0 else 1.0
    words = f"  NOT white: residuals of {worst} correlate by {lag[worst]:.2f} with the next"
    return [words + (f"; the ± are about {wider:.1f} times too small" if wider > 1.1 else "")]


def _plus_minus(x: float, sd: float):
    if not np.isfinite(sd):
        return f"{x:.6g} (not determined)"
    if sd == 0:
        return f"{x:.9g}"
    digits = max(0, int(np.floor(np.log10(abs(x) / sd))) + 2) if x else 2
    digits = min(max(digits, 2), 12)
    return f"{x:#.{digits}g} ± {sd:.2g}"


# A number is at its bound if it is closer to it than this, relative to its start value.
AT_BOUND = 1e-6


class Channel(NamedTuple):
    """A measured quantity: its name, times (T,) (None for ends), measurements and residuals, (T, ...)."""

    name: str
    t: np.ndarray | None
    measured: np.ndarray
    residuals: np.ndarray


# A step is a gap if it is so many times the median one; a curve across gaps has so many points.
GAP, DRAWN = 1.5, 512


# Not an `eqx.Module`, which wraps a method each time it is looked up.
@jtu.register_dataclass
@dataclass(frozen=True, eq=False, repr=False)
class Fit:
    """Estimates from measured motion. It prints itself as a table and plots data, fit and residuals.

    - `params`: the parameters, with the estimates inserted. `q0`, `v0`: the start of each record, a list.
    - `names`, `values`, `sd` (p,): the fitted numbers and their standard deviations; NaN for numbers that the data do
      not determine. With `sigma` given the standard deviations follow from it, else from the residuals.
    - `covariance`, `correlation` (p, p).
    - `start_sd`: standard deviations of `q0` and `v0`, as two lists of pytrees; 0 where held, NaN where the data do not
      determine the start.
    - `identifiability`: which combinations the data determine. `laplace()`: a normal distribution with the true second
      derivatives. `log_likelihood`, `log_posterior`: for samplers.
    - `chi2`, `freedom`: the sum of squared residuals in sigmas (without sigmas, in units of the data's spread), and the
      number of measurements minus that of unknowns. `noise`: the estimated sigma, if none was given.
    - `result`: a `RESULTS` item: `lj.RESULTS.successful`, `not_converged` or `misfit`. `converged`: whether it is the
      first: the search came to rest, and the residuals neither contradict `sigma` nor follow a curve.
    - Arrays are NumPy arrays, unless the fit is part of a compiled program.
    - `steps`, `cost`: of the search. `costs`: from each start, the guess first; NaN for starts that were not needed.
    """

    problem: FitProblem
    unknowns: Unknowns
    cost: Float[Array, ""]
    steps: Int[Array, ""]
    rested: Bool[Array, ""]
    misfit: Misfit
    costs: Float[Array, " starts"]
    evaluation: Evaluation | None
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
        return is_traced((self.cost, self.unknowns))

    @property
    def _xp(self) -> Any:
        """NumPy, which needs no compiling, or `jax.numpy` if the fit is traced."""
        return jnp if self._traced else np

    def report(self) -> Report:
        """The outcome, for the status of a sweep."""
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
        """The variance of an error in sigmas: 1 if sigmas were given."""
        xp = self._xp
        if self.problem.absolute:
            return xp.ones_like(self.chi2)
        # With as many unknowns as measurements no residuals are left to estimate the errors from.
        return xp.where(self.freedom > 0, self.chi2 / xp.maximum(self.freedom, 1), np.nan)

    @property
    def noise(self) -> Float[Array, ""]:
        """The size of a measurement error: 1, in sigmas, if these were given; else estimated, in the data's unit."""
        first = jax.tree.leaves(self.problem.sigma)[0]
        xp = self._xp
        return xp.sqrt(self.variance) * (1.0 if self.problem.absolute else xp.nanmax(first))

    @property
    def covariance(self) -> Float[Array, "p p"]:
        known = self.determined[:, None] & self.determined[None, :]
        return self._xp.where(known, self._error_variance() * self._evaluated().covariance.shared, np.nan)

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
        # On constraints a start also depends on the parameters, such as the unknown length of a rod.
        xp, evaluation, windows = self._xp, self._evaluated(), self.problem.windows.first
        of, determined, of_errors = evaluation.covariance, evaluation.determined, self._error_variance()
        _, slopes = self.known_starts()
        sds = []
        for r, w in enumerate(windows):
            joint = of_errors * xp.block([[of.shared, of.local_shared[w].T], [of.local_shared[w], of.local[w]]])
            known = xp.concatenate([determined.shared, determined.local[w]])

            def sd(slopes: Any, r: int = r, joint: Array = joint, known: Array = known):
                with np.errstate(invalid="ignore"):
                    variance = xp.einsum("...i,ij,...j", slopes[r], joint, slopes[r])
                unknown = xp.any(xp.where(known, 0.0, slopes[r]) != 0, axis=-1)
                return xp.where(unknown, np.nan, xp.sqrt(xp.maximum(variance, 0.0)))

            sds.append(jax.tree.map(sd, slopes))
        of_q, of_v = zip(*sds)
        return list(of_q), list(of_v)

    def _evaluated(self) -> Evaluation:
        if self.evaluation is None:
            raise ValueError(
                f"uncertainties of {len(self.names)} numbers are not computed.\n"
                "Fix: fit fewer of them: freeze a network with free=[...]."
            )
        return self.evaluation

    def _error_variance(self):
        """The variance of an M-estimate, relative to that of least squares with these sigmas."""
        if self.problem.loss == "squares":
            return self.variance
        return _robust_variance(self._evaluated().rows.reshape(-1), self.known(), self.problem.loss)

    def known(self) -> Bool[Array, " windows*m"]:
        """Which of the residuals `evaluation.rows`, flattened, belong to a measurement."""
        parts = []
        for kind, tree in self.problem.measured.items():
            for x, s in zip(jax.tree.leaves(tree), jax.tree.leaves(self.problem.sigma[kind])):
                xp: Any = numpy_of((x, s))
                known = xp.isfinite(x) & xp.isfinite(s)
                parts.append(known.reshape(known.shape[0], -1))
        by_window: Any = numpy_of(parts).concatenate(parts, axis=1)
        return by_window.reshape(-1)

    def starts(self) -> list[tuple[PyTree, PyTree]]:
        """(q, v) at the start of each record."""
        states, _ = self.known_starts()
        return [jax.tree.map(lambda x, r=r: x[r], states) for r in range(len(self.problem.windows.first))]

    def known_starts(self) -> tuple[PyTree, PyTree]:
        """The starts of all records, and their slopes by the unknowns."""
        system = self.problem.system
        if isinstance(system, UnknownSystem):
            return system.starts
        return starts_at(self.problem, self.unknowns, self.problem.windows.first)

    def motion(self, record: int = 0, ts: ArrayLike | None = None) -> Trajectory:
        """The fitted motion of a record from its start, at its times or at others from the same start."""
        windows = np.flatnonzero(np.asarray(self.problem.windows.record) == record)
        params, (q, v) = self.problem.params(self.unknowns.shared, int(windows[0])), self.starts()[record]
        if ts is None:
            real = np.asarray(self.problem.windows.real)
            ts = np.concatenate([np.asarray(self.problem.windows.ts)[i][real[i]] for i in windows])
        return integrate(self.problem.system, q, v, params, ts=ts, **({"throw": False} | self.problem.options))

    def residuals(self, record: int | None = None) -> dict[str, np.ndarray]:
        """Predicted minus measured values by channel, (T, ...) in the data's unit, NaN where nothing was measured.

        Those of all records in sequence, or of one.
        """
        return {channel.name: channel.residuals for channel in self.channels(record)}

    def rms(self, record: int | None = None) -> dict[str, float]:
        """The root mean square of the residuals by channel, in the data's unit."""
        return {name: float(np.sqrt(np.nanmean(r**2))) for name, r in self.residuals(record).items()}

    def whiteness(self) -> dict[str, float]:
        """The correlation of each residual with the next, by channel; for n white residuals it is 0 to within 2/√n."""
        correlations = {}
        for name, r in self.residuals().items():
            r = r.reshape(len(r), -1) / np.sqrt(np.nanmean(r**2))
            correlations[name] = float(np.nanmean(r[1:] * r[:-1])) if len(r) > 1 else np.nan
        return correlations

    def channels(self, record: int | None = None) -> Iterator[Channel]:
        """Each measured quantity, of all records in sequence, or of one."""
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
        """The unknowns as `log_likelihood` takes them: parameters by name, and deviations of the starts, (W, k)."""
        # A sampler needs JAX arrays.
        of_names = {name: jnp.asarray(self.unknowns.shared[i]) for i, name in enumerate(self.names)}
        return of_names | {"starts": jnp.asarray(self.unknowns.local)}

    @property
    def log_likelihood(self) -> Callable[[Mapping[str, Array]], Float[Array, ""]]:
        """A function: the logarithm of the probability density of the measurements, up to a constant; without priors.

        For samplers: it is differentiable and can be jitted. It takes unknowns as in `sampling`; those left out stay at
        their estimates. -inf outside the bounds, and where the motion fails.
        """
        found, variance = self.problem.found, self.variance

        def density(unknowns: Mapping[str, Array]):
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

        def density(unknowns: Mapping[str, Array]):
            known = self.sampling | dict(unknowns)
            off = [(known[name] - found.mean[i]) / found.sd[i] for i, name in enumerate(self.names)]
            return likelihood(unknowns) - 0.5 * sum((jnp.asarray(x) ** 2 for x in off), jnp.zeros(()))

        return density

    def laplace(self) -> Laplace:
        """The normal distribution with the peak and the true second derivatives of `log_posterior`, and its evidence.

        It says where these differ from those behind `covariance`, and where there is no peak (with an `lj.FitWarning`).

        **Raises:** `ValueError` for joined windows, whose starts are not free; `TypeError` if the fit is traced.
        """
        must_have_values((self.cost, self.unknowns), "laplace() needs numbers")
        evaluation = self._evaluated()
        priors = np.isfinite(self.problem.found.sd).sum()
        without_seams = self.known().sum() + priors - sum(np.sum(d) for d in evaluation.determined)
        # Each joined state removes an unknown, and so raises the freedom.
        if self.freedom > without_seams + 0.5:
            raise ValueError(
                "the windows of this fit are joined, but log_likelihood gives each a start of its own.\n"
                "Fix: lj.fit(system, records, found.params), without window=, from these estimates."
            )
        approximation = laplace(self.problem, self.unknowns, float(self.variance))
        if not approximation.positive_definite:
            warnings.warn(f"Laplace: {approximation.caveats[0]}", FitWarning, stacklevel=2)
        return approximation

    def at_bounds(self) -> list[str]:
        """The names of numbers that ended at a bound."""
        found, x = self.problem.found, np.asarray(self.values)
        low, high = np.asarray(found.low), np.asarray(found.high)
        size = np.maximum(np.abs(np.asarray(found.start)), 1e-300)
        near = (x - low < AT_BOUND * size) | (high - x < AT_BOUND * size)
        return [name for name, at in zip(self.names, near) if at]

    def save(self, path: str | os.PathLike) -> None:
        """Write the fit into an npz file; `lj.load_fit(path, system)` reads it, bit for bit.

        Functions are not saved: the system, `observe`, and options that contain functions. An interrupted write leaves
        the previous file intact.

        **Raises:** `TypeError` for values in `params` that are not data, by name; `OSError` if there is no such folder.
        """
        must_have_values(self, "a fit is saved by its values", "save it outside of the program")
        problem = self.problem
        # Without phases, `first` is the system itself.
        roles = {id(problem.first): "first", id(problem.system): "system", id(problem.unflatten): "unflatten"}
        if problem.observe is not None:
            roles[id(problem.observe)] = "observe"
        for name, value in problem.options.items():
            if isinstance(value, NotGiven) or not _is_data(value):
                roles[id(value)] = f"options.{name}"
        writer = Writer(lambda value: roles.get(id(value)))
        contents = {"fit": writer.down(self, ""), "known": writer.down(_known_of_system(self), "system")}
        contents["q"] = writer.down(
            jax.tree.map(np.asarray, problem.unflatten(problem.starts.q.guess[0])), "coordinates"
        )
        contents["functions"] = sorted(set(roles.values()) - {"first", "unflatten"})
        npz.write(path, "fit", contents, writer.arrays)

    def plot(self, record: int = 0):
        """Draw data, fit and residuals of a record, one row per channel; returns a matplotlib `Figure`.

        Where samples are missing the fitted motion is drawn between its neighbours: integrated once more, if the system
        is known.
        """
        panels = {name: rest for name, *rest in self.channels(record) if rest[0] is not None}
        known = not isinstance(self.problem.system, UnknownSystem)
        gaps = known and any(_has_gaps(t, measured) for t, measured, _ in panels.values())
        return plot.fits(panels, self._curves(record) if gaps else {})

    def _curves(self, record: int) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """What the fitted motion predicts, by channel, at times closer than the samples; NaN between windows."""
        windows = np.flatnonzero(np.asarray(self.problem.windows.record) == record)
        states, _ = starts_at(self.problem, self.unknowns, windows)
        count, curves = max(DRAWN // len(windows), 16), {}
        for i, w in enumerate(windows):
            of_window, (q, v) = self.problem.windows.ts[w], jax.tree.map(lambda x, i=i: x[i], states)
            ts = np.linspace(of_window[0], of_window[self.problem.windows.last[w]], count)
            params, options = self.problem.params(self.unknowns.shared, w), {"throw": False} | self.problem.options
            predicted = self.problem.predicted(integrate(self.problem.system, q, v, params, ts=ts, **options))
            for kind, tree in predicted.items():
                for path, x in jtu.tree_leaves_with_path(tree) if kind != "end" else ():
                    known = curves.setdefault(channel_name(kind, path), [])
                    known.append((np.append(ts, np.nan), np.append(x, np.full_like(x[-1:], np.nan), axis=0)))
        return {k: (np.concatenate([t for t, _ in x]), np.concatenate([y for _, y in x])) for k, x in curves.items()}

    def __repr__(self):
        if is_traced(self.cost):
            return f"Fit of {listed(list(self.names))}, being traced"
        return by_line("\n".join(lines_of(self)))


def _has_gaps(t: np.ndarray, measured: np.ndarray) -> bool:
    steps = np.abs(np.diff(t))
    return len(t) > 1 and not (np.all(np.isfinite(measured)) and np.all(steps <= GAP * np.median(steps)))


def _is_data(value: Any):
    try:
        Writer().down(value, "")
    except NotWritable:
        return False
    return True


def _known_of_system(fit: "Fit") -> dict[str, Any]:
    system = fit.problem.system
    if isinstance(system, UnknownSystem):
        return {name: getattr(system, name) for name in system.__dataclass_fields__}
    q, v = jax.tree.map(np.asarray, fit.starts()[0])
    params = fit.problem.params(fit.unknowns.shared, 0)
    params = jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, params)
    t = np.asarray(np.asarray(fit.problem.windows.ts)[0, 0], jax.tree.leaves(q)[0].dtype)
    state = State(t, q, v, params)
    phase = int(system.first) if system.in_phases else None
    about = {"words": repr(system), "angles": (), "signature": signature(system, state), "state": tuple(state)}
    return about | {"starts": jax.tree.map(np.asarray, fit.known_starts()), "phase": phase}


@partial(compiled, in_numpy=True)
def _rows(problem: FitProblem, u: Unknowns):
    """The residuals of all windows, without a robust loss."""
    return equations(replace(problem, loss="squares"), u, WHOLE).rows


@partial(compiled, in_numpy=True)
def _robust_variance(r: Array, known: Array, loss: str):
    """The variance of an M-estimate: Huber, *Robust Statistics*, Eq. (7.6.2)."""
    constant, _ = LOSSES[loss]
    slope = jax.grad(lambda r: 0.5 * dampened(r, loss) ** 2)
    r = jnp.where(r == 0, constant * 1e-9, r)
    squares, curvatures = jax.vmap(slope)(r) ** 2, jax.vmap(jax.grad(slope))(r)
    return jnp.mean(squares, where=known) / jnp.mean(curvatures, where=known) ** 2


# A search has gone astray if a number ends this many times as large as its guess.
ASTRAY = 1e6


def caveats(fit: Fit) -> list[str]:
    """What a user has to know about a fit, the most serious first."""
    words = [_search_caveat(fit), _astray_caveat(fit), _sigma_caveat(fit) or _curve_caveat(fit)]
    if fit.evaluation is not None:
        words += [_parameters_caveat(fit, fit.evaluation), _motion_caveat(fit, fit.evaluation)]
        words += [] if fit.problem.absolute else [_freedom_caveat(fit)]
    if at := fit.at_bounds():
        words.append(f"{listed(at)} ended at a bound, where uncertainties mean nothing.")
    return [caveat for caveat in words if caveat]


def _search_caveat(fit: Fit):
    if bool(fit.rested):
        return ""
    return (
        f"the search stopped after {int(fit.steps)} steps without converging; this is its best point.\n"
        "Usual cause: a guess too far off, parameters that the data hardly determine, noise in the motion itself.\n"
        "Fix: look at found.plot(); try restarts=8, a shorter window=, or iterations=1000."
    )


def _astray_caveat(fit: Fit):
    guesses = zip(fit.names, np.asarray(fit.problem.found.start), np.asarray(fit.values))
    for name, guess, x in guesses:
        if guess and abs(x) > ASTRAY * abs(guess):
            return (
                f"the search went astray: '{name}' was guessed to be {guess:.4g}, and ended at {x:.4g}.\n"
                "Usual cause: a guess too far off, outliers, angles wrapped to one turn.\n"
                f'Fix: bounds={{"{name}": (low, high)}}, a better guess, a shorter window=, or loss="cauchy".'
            )
    return ""


def _parameters_caveat(fit: Fit, at: Evaluation):
    if rank_of(np.asarray(at.singular_values)) == len(fit.names):
        return ""
    return (
        f"the data do not determine all parameters.\n{fit.identifiability}\n"
        "An undetermined parameter has no uncertainty. One that leaves no trace keeps its guess; of others only the "
        "combinations above mean something.\n"
        "Fix: leave some out of free=, give priors=, or measure more."
    )


def _motion_caveat(fit: Fit, at: Evaluation):
    failed = np.flatnonzero(~np.asarray(at.well))
    if not failed.size:
        return ""
    record, windows = int(fit.problem.windows.record[failed[0]]), fit.problem.windows.count
    which = f"the motion of record {record} stops"
    if failed.size > 1:
        share = f"{failed.size} of {windows} motions ({100 * failed.size / windows:.0f} %)"
        which = f"{share}, the first of them of record {record}, stop"
    return (
        f"at the estimates {which} early; samples after that count as large residuals.\n"
        f"Fix: found.motion({record}).result says why; give a better guess, or bounds=."
    )


def _sigma_caveat(fit: Fit):
    large = [name for name, large in zip(_channels(fit), np.asarray(fit.misfit.large)) if large]
    if not large:
        return ""
    times = float(np.nanmax(fit.misfit.times))
    return (
        f"the residuals of {listed(large)} are {times:.2g} times as large as sigma says, so the ± mean nothing.\n"
        "Usual cause: a wrong minimum, something that the system leaves out, outliers, or too small a sigma.\n"
        'Fix: look at found.plot(); try a shorter window=, restarts=30, loss="cauchy".'
    )


def _freedom_caveat(fit: Fit):
    if float(fit.freedom) > 0:
        return ""
    return (
        "there are as many unknowns as measurements, so their uncertainties cannot be estimated.\n"
        "Fix: measure more, free fewer, or say how large the errors are: lj.Record(..., sigma=0.01)."
    )


def _curve_caveat(fit: Fit):
    missed = [name for name, curved in zip(_channels(fit), np.asarray(fit.misfit.curved)) if curved]
    if not missed:
        return ""
    return (
        f"the residuals of {listed(missed)} are not measurement errors: they are large and follow a curve.\n"
        "Usual cause: a wrong minimum, or something that the system leaves out.\n"
        "Fix: look at found.plot(); try a better guess, restarts=30, a shorter window=."
    )


def _channels(fit: Fit):
    """The names of what was measured, in the order of a `Misfit`."""
    paths = {kind: jax.tree_util.tree_leaves_with_path(tree) for kind, tree in fit.problem.measured.items()}
    return [channel_name(kind, path) for kind, leaves in paths.items() for path, _ in leaves]
