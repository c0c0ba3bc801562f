"""Scalings x to s^a x, t to s^b t that multiply L by a factor: they map motions to motions, and conserve nothing.

Under a combined scaling, L dt changes at a rate that is linear in the exponents. If this rate is c L dt at every state,
L is multiplied by s^(c - b). With c = 0 the scaling is a Noether symmetry and listed among these instead.

Source: Landau & Lifshitz, *Mechanics*, §10.
"""

from fractions import Fraction

import numpy as np

from lagjax.analysis.precision import Precision
from lagjax.analysis.symmetry.ansatz import Basis
from lagjax.analysis.symmetry.charge_rates import Rates
from lagjax.analysis.symmetry.null_space import independent, null_space
from lagjax.analysis.symmetry.result import Scaling


def scalings_of(model, tried: Basis, sampled: Rates, precision: Precision) -> tuple[Scaling, ...]:
    """The scalings that multiply L by a factor."""
    if model.system.force is not None or model.system.dissipation is not None:
        return ()
    chosen = np.flatnonzero(np.array(tried.kinds) == "scaling")
    flat = lambda i: np.append(tried.affine.matrix[i].ravel(), tried.affine.clock_rate[i])
    chosen = chosen[independent(np.stack([flat(i) for i in chosen], axis=1), precision)]
    size = sampled.size[chosen]
    holonomic = model.holonomic
    root = np.sqrt(len(sampled.value))
    rows = lambda y: y.reshape(-1, y.shape[-1])
    # The set g = 0 and the velocity constraints must be preserved.
    kept = np.concatenate([rows(sampled.displacement[:, holonomic]), rows(sampled.invariance[:, ~holonomic])])[
        :, chosen
    ]
    changed = np.concatenate([sampled.charge[:, chosen], -sampled.value[:, None]], axis=1)
    kept = np.concatenate([kept, np.zeros((len(kept), 1))], axis=1)
    found = null_space(np.concatenate([changed, kept]) / root, precision)
    scalings = []
    known = model.names
    for vector in found.vectors:
        if abs(vector[-1]) <= precision.zero * 100 * np.max(np.abs(vector)):
            continue
        weights = vector[:-1] / size
        of_q = np.diagonal(np.tensordot(weights, tried.affine.matrix[chosen], 1))
        exponents = dict(zip(known, of_q)) | {"t": weights @ tried.affine.clock_rate[chosen]}
        # L dt is multiplied by s^c, hence L by s^(c - b).
        scalings.append(_tidied(exponents, float(vector[-1]), _worst(changed, kept, vector), 10 * precision.null))
    return tuple(scalings)


def _worst(changed, kept, vector):
    left = max(np.max(np.abs(rows @ vector), initial=0.0) for rows in (changed, kept))
    return float(left / np.max(np.abs(vector)))


def _tidied(exponents, action, residual, agrees) -> Scaling:
    unit = next((x for x in exponents.values() if abs(x) > agrees), 1.0)

    def nice(x):
        plain = Fraction(float(x)).limit_denominator(12)
        return float(plain) if abs(x - plain) < agrees else float(x)

    shown = {name: nice(x / unit) for name, x in exponents.items()}
    factor = nice((action - exponents["t"]) / unit)
    return Scaling({name: x for name, x in shown.items() if x}, factor, residual)
