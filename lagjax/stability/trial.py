"""One row of the stability report: a hard motion, its exact answer, and the library's result.

A row is *accurate* if its error is a small multiple of the tolerance, *degraded* if the library warned or its own error
estimate shows the error, and *refused* if it raised. Everything else is *silently wrong*. The tolerance bounds the
error per period, an energy error shifts the phase in all later periods, and the motion itself may amplify errors. Hence

    allowed = PER_PERIOD · tolerance · periods · (1 + periods/1000) · amplification, and never above USELESS

and ten times that for the derivative of the motion. Neither was fitted to the results. If a derivative is known, the
motion also runs as one of several lanes of a compiled program with derivatives, and must be as accurate there.
"""

import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.display import table
from lagjax.integrate import Trajectory, integrate
from lagjax.jaxtools import compiled
from lagjax.report import FULL, relative_error
from lagjax.system import System, coordinates

PER_PERIOD = 100.0
# A result with fewer than two correct digits is never accurate, whatever the tolerance.
USELESS = 1e-2
OF_DERIVATIVES = 10.0
# An error counts as reported if it is at most this many times its estimate.
REPORTED_WITHIN = 10.0
# The offsets of the lanes' starts along the direction of the derivative; the first lane is the row itself.
LANES = 0.0, 1e-3
ACCURATE, DEGRADED, REFUSED, SILENTLY_WRONG = "accurate", "degraded", "refused", "SILENTLY WRONG"
VERDICTS = (ACCURATE, DEGRADED, REFUSED, SILENTLY_WRONG)


@dataclass(frozen=True)
class Outcome:
    """The result of a row.

    - `effort`: the number of steps, accepted and rejected, or the largest stable step.
    - `error`: relative to the exact answer; infinite if there is no result. `allowed`: the error that counts as
      accurate.
    - `residual`: of the constraints, None without constraints.
    - `lanes`: the error of the same motion in lanes of a program; `gradient`: the relative error of its derivative
      there, in forward mode; both None if not tried.
    - `estimated`: the motion's own estimate of the error in the same measure; None if it has none.
    - `said`: the first sentence of each warning or of the error that the library raised.
    - `expected`: the verdict that the row should have; None if any verdict except silently wrong is acceptable.
    """

    family: str
    name: str
    method: str
    effort: str
    error: float
    allowed: float
    residual: float | None = None
    lanes: float | None = None
    gradient: float | None = None
    estimated: float | None = None
    raised: bool = False
    said: str = ""
    expected: str | None = None

    @property
    def verdict(self) -> str:
        """One of `VERDICTS`."""
        if self.raised:
            return REFUSED
        if self.said:
            return DEGRADED
        errors = self.error, self.lanes or 0.0, (self.gradient or 0.0) / OF_DERIVATIVES
        # `<=` so that NaN is not accurate.
        if all(error <= self.allowed for error in errors):
            return ACCURATE
        reported = REPORTED_WITHIN * (self.estimated or 0.0)
        return DEGRADED if all(error <= max(reported, self.allowed) for error in errors) else SILENTLY_WRONG

    @property
    def passed(self) -> bool:
        """Whether the row is not silently wrong and has the expected verdict."""
        return self.verdict != SILENTLY_WRONG and self.expected in (None, self.verdict)


def zeros(tree):
    """The zero direction for `tree`."""
    return jax.tree.map(lambda x: np.zeros(np.shape(x)), tree)


def by_parameter(q0: PyTree, v0: PyTree, params: PyTree, name: str, size=1.0):
    """The direction that changes one parameter."""
    return zeros(q0), zeros(v0), zeros(params) | {name: size}


def _states(trajectory):
    return trajectory.q, trajectory.v


@dataclass(frozen=True)
class Trial:
    """A motion to integrate and its exact answer.

    - `exact(q0, v0, params, ts)`: the exact value of `observed(trajectory)`, by default (q, v); differentiable.
    - `method`: None for the default. `along`: (dq0, dv0, dparams), the direction of the derivative; None for no check
      of the derivative and of lanes.
    - `tolerance`: the requested one; `options`: further options of `integrate`, such as an atol per coordinate.
    - `derived_in`: the least tier that looks at the derivative and lanes, which compile for three times as long.
    - `periods`: the length of the motion; `amplification`: the factor by which it magnifies an error of its start.
    """

    family: str
    name: str
    system: System
    q0: PyTree
    v0: PyTree
    params: PyTree
    ts: np.ndarray
    exact: Callable[..., PyTree] | None = None
    along: tuple[PyTree, PyTree, PyTree] | None = None
    tolerance: float = 1e-10
    method: diffrax.AbstractSolver | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    observed: Callable[[Trajectory], PyTree] = _states
    periods: float = 1.0
    amplification: float = 1.0
    expected: str | None = ACCURATE
    tier: int = FULL
    derived_in: int = FULL

    @property
    def allowed(self) -> float:
        """The error that counts as accurate."""
        periods = max(1.0, self.periods) * (1 + self.periods / 1000)
        bound = PER_PERIOD * self.tolerance * periods * max(1.0, self.amplification)
        return min(bound, USELESS)

    def attempt(self) -> Outcome:
        """Integrate as a user would, and compare with the exact answer."""
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                trajectory = integrate(self.system, self.q0, self.v0, self.params, ts=self.ts, **self._options())
            except (ValueError, RuntimeError) as error:
                return self._outcome(raised=True, said=_first_sentence(error))
        steps = f"{int(trajectory.stats['num_steps'])} steps"
        said = "; ".join(_first_sentence(warning.message) for warning in caught)
        residual = float(trajectory.residual()) if self.system.constraints else None
        if self.exact is None:
            return self._outcome(trajectory.static.how.method, effort=steps, residual=residual, said=said)
        error = relative_error(self.observed(trajectory), self.exact(*self._exact_inputs()))
        lanes, gradient = self._errors_in_lanes(self.exact)
        return self._outcome(
            trajectory.static.how.method, effort=steps, error=error, residual=residual, said=said, lanes=lanes,
            gradient=gradient, estimated=self._estimated(trajectory),
        )  # fmt: skip

    def _estimated(self, trajectory):
        if self.observed is not _states or trajectory.error is None:
            return None
        leaves = zip(jax.tree.leaves(_states(trajectory.error)), jax.tree.leaves(_states(trajectory)))
        return max(float(np.max(error) / (np.max(np.abs(x)) or 1.0)) for error, x in leaves)

    def _options(self):
        return {"rtol": self.tolerance, "atol": self.tolerance, "method": self.method, **self.options}

    def _outcome(self, chosen="", effort="", error=float("inf"), **what):
        asked = f"default {chosen}".strip() if self.method is None else type(self.method).__name__
        return Outcome(
            family=self.family, name=self.name, method=asked, effort=effort, error=error,
            allowed=self.allowed, expected=self.expected, **what,
        )  # fmt: skip

    def _exact_inputs(self):
        """The inputs, rounded to the motion's dtype and converted back to double precision."""
        start = coordinates.state(self.ts[0], self.q0, self.v0, self.params)
        ts = np.asarray(self.ts).astype(start.t.dtype)
        return jax.tree.map(lambda x: jnp.asarray(x, float), (start.q, start.v, start.params, ts))

    def _errors_in_lanes(self, exact):
        if self.along is None:
            return None, None
        *inputs, ts = self._exact_inputs()
        tangents = jax.tree.map(lambda x, dx: jnp.broadcast_to(jnp.asarray(dx, float), x.shape), inputs, [*self.along])
        wanted = jax.jvp(lambda *x: exact(*x, ts), tuple(inputs), tuple(tangents))
        start = coordinates.state(self.ts[0], self.q0, self.v0, self.params)
        point, dtype = [start.q, start.v, start.params], start.t.dtype
        tangents = jax.tree.map(lambda x, dx: dx.astype(x.dtype), point, tangents)
        options = jax.tree.map(
            lambda x: np.asarray(x, dtype) if isinstance(x, (float, np.ndarray)) else x, self._options()
        )
        got = _in_lanes(self.system, point, tangents, np.asarray(self.ts, dtype), options, self.observed)
        return relative_error(got[0], wanted[0]), relative_error(*map(_gathered, (got[1], wanted[1])))


@compiled
def _in_lanes(system, point, tangents, ts, options, observed):
    """The observed values and their directional derivative in forward mode; the other lanes start displaced."""

    def motion(q0: PyTree, v0: PyTree, params: PyTree):
        return observed(integrate(system, q0, v0, params, ts=ts, throw=False, **options))

    def lane(along):
        moved = jax.tree.map(lambda x, dx: x + along * dx, tuple(point), tuple(tangents))
        return jax.jvp(motion, moved, tuple(tangents))

    lanes = jax.vmap(lane)(jnp.asarray(LANES, ts.dtype))
    return jax.tree.map(lambda x: x[0], lanes)


def _gathered(tree):
    """One vector of coordinates and one of velocities: the error of a derivative is relative to the largest of each."""
    parts = tree if isinstance(tree, tuple) else (tree,)
    return [np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(part)]) for part in parts]


def _first_sentence(message):
    return str(message).split("\n")[0]


def stability_table(outcomes: Sequence[Outcome]) -> str:
    """The report: one line an outcome, then the count of each verdict."""
    header = (
        "",
        "method",
        "steps",
        "error",
        "estimated",
        "allowed",
        "residual",
        "in lanes",
        "gradient",
        "verdict",
        "what the library said",
    )
    cells = [_cells(outcome) for outcome in outcomes]
    counts = {verdict: sum(outcome.verdict == verdict for outcome in outcomes) for verdict in VERDICTS}
    return "\n".join(
        [
            table(header, cells, prose=True),
            "",
            "error and gradient: relative, against the exact motion and its exact derivative; in lanes: the error of "
            "the same motion in a compiled batch with derivatives; estimated: the motion's own estimate of its error; "
            f"accurate: at most {PER_PERIOD:g} tolerances per period, more after thousands, times the motion's own "
            f"amplification, and {OF_DERIVATIVES:g} times that for the gradient",
            ", ".join(f"{count} {verdict}" for verdict, count in counts.items()),
        ]
    )


def _cells(outcome):
    def number(x: float | None) -> str:
        return "-" if x is None or not np.isfinite(x) else f"{x:.1e}"

    verdict = outcome.verdict if outcome.passed else f"{outcome.verdict} (!)"
    return (
        f"{outcome.family}: {outcome.name}",
        outcome.method,
        outcome.effort or "-",
        number(outcome.error),
        number(outcome.estimated),
        f"{outcome.allowed:.0e}",
        number(outcome.residual),
        number(outcome.lanes),
        number(outcome.gradient),
        verdict,
        _short(outcome.said),
    )


def _short(text, longest=120):
    """The text shortened to its beginning and its end, which contains the reason."""
    half = (longest - 5) // 2
    return text if len(text) <= longest else f"{text[:half]} ... {text[-half:]}"
