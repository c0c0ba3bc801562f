"""The largest stable fixed step, found by trial, compared with the method's stability function.

One step of a Runge-Kutta method (A, b) on y' = λ y multiplies y by R(z) = 1 + z bᵀ (I - z A)⁻¹ 1, z = h λ. On the
oscillator q̈ = -ω² q the eigenvalues are λ = ±iω: the step is stable as long as |R(ihω)| <= 1.

Source: Hairer & Wanner, *Solving ODEs II*, §IV.2.
"""

from dataclasses import dataclass, field

import diffrax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from lagjax.integrate import integrate
from lagjax.report import FULL
from lagjax.stability.trial import ACCURATE, Outcome
from lagjax.system import System

# A step is stable if the amplitude grows by less than GROWTH in STEPS steps; |R| of Dopri8 crosses 1 steeply.
STEPS, GROWTH = 4000, 1.01
OMEGA = 1e5
HALVINGS = 20


def lagrangian(t, q: PyTree, v: PyTree, params: PyTree):
    """L = ½ v² - ½ ω² q²."""
    return 0.5 * v**2 - 0.5 * params["omega"] ** 2 * q**2


oscillator = System(lagrangian)


def exact(q0: PyTree, v0: PyTree, params: PyTree, ts):
    """The exact q and its rate."""
    w = params["omega"]
    return q0 * jnp.cos(w * ts) + v0 / w * jnp.sin(w * ts), v0 * jnp.cos(w * ts) - w * q0 * jnp.sin(w * ts)


def amplification(method, z):
    """R(z) for an array of z, computed stage by stage from the method's lower triangular tableau."""
    tableau, z = method.tableau, np.asarray(z)
    diagonal = np.zeros(len(tableau.b_sol)) if tableau.a_diagonal is None else tableau.a_diagonal
    stages = []
    for row, on_diagonal in zip([[], *tableau.a_lower], diagonal):
        stages.append((1 + z * sum((a * k for a, k in zip(row, stages)), 0 * z)) / (1 - z * on_diagonal))
    return 1 + z * sum(b * k for b, k in zip(tableau.b_sol, stages))


def stable_limit(method, growth=GROWTH, steps=STEPS) -> float:
    """The smallest hω at which the amplitude grows by more than `growth` in `steps` steps; infinite if none does."""
    y = np.concatenate([np.linspace(1e-4, 20.0, 200_000), np.logspace(np.log10(20.0), 6, 1000)])
    unstable = y[steps * np.log(np.abs(amplification(method, 1j * y))) > np.log(growth)]
    return unstable[0] if unstable.size else np.inf


@dataclass(frozen=True)
class StableStep:
    """The largest stable step of a method on a stiff oscillator, by bisection."""

    method: diffrax.AbstractSolver
    expected: str | None = ACCURATE
    tier: int = FULL
    family: str = field(default="stable step", init=False)

    def attempt(self) -> Outcome:
        """Bisect between a stable and an unstable step."""
        low, high = 0.05, 40.0
        limit = stable_limit(self.method)
        if self._stable(1e6):
            measured, effort = np.inf, "any h"
        else:
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                low, high = (middle, high) if self._stable(middle) else (low, middle)
            measured, effort = low, f"h = {low:.4f}/omega"
        same = np.isinf(limit) and np.isinf(measured)
        return Outcome(
            family=self.family,
            name=f"oscillator of omega = {OMEGA:g}, against |R(ihω)| = 1",
            method=type(self.method).__name__,
            effort=effort,
            error=0.0 if same else abs(measured / limit - 1),
            allowed=1e-3,
            expected=self.expected,
        )

    def _stable(self, step):
        h = step / OMEGA
        motion = integrate(
            oscillator, 1.0, 0.0, {"omega": OMEGA}, ts=np.array([0.0, STEPS * h]), method=self.method, throw=False,
            dt0=h, stepsize_controller=diffrax.ConstantStepSize(),
        )  # fmt: skip
        amplitude = np.hypot(float(motion.end.q), float(motion.end.v) / OMEGA)
        return bool(amplitude <= GROWTH)
