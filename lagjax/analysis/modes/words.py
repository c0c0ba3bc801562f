"""The stability verdict and the modes in words."""

import jax
import numpy as np

from lagjax.analysis.modes.eigenmodes import ASYMPTOTIC, DIVERGENCE, FLUTTER, GYROSCOPIC, STABLE, UNDECIDED, UNSTEADY

VERDICTS = {
    STABLE: "stable",
    ASYMPTOTIC: "asymptotically stable",
    GYROSCOPIC: "gyroscopically stabilised",
    DIVERGENCE: "divergence",
    FLUTTER: "flutter",
    UNDECIDED: "undecided",
    UNSTEADY: "no steady motion",
}
# Entries of a shape below this fraction of the largest are not named.
NAMED_ABOVE = 1e-6


def reason_of(modes) -> str:
    """The reason for the verdict, in one sentence."""
    code, kind = int(modes.code), modes.linearisation.kind
    growth = np.asarray(modes.growth)
    worst = int(np.argmax(growth)) if growth.size else 0
    if code == UNSTEADY:
        off = float(modes.linearisation.residual)
        return f"the state is no equilibrium (residual {off:.2g}), or its mass matrix is singular"
    if code == DIVERGENCE and not np.any(np.asarray(modes.growing)):
        return "no root grows, but the first term that does not vanish along the zero mode pushes away"
    if code == DIVERGENCE:
        return f"mode {worst} grows by a factor e in {1 / growth[worst]:.4g}, without swinging"
    if code == FLUTTER:
        return f"mode {worst} swings and grows by a factor e in {1 / growth[worst]:.4g}"
    if code == UNDECIDED:
        if int(modes.unexplained):
            return (
                "a root of zero that no coordinate explains: a symmetry of several together, or a critical point, at "
                "which terms of higher order decide"
            )
        return "two modes share root and shape, and grow together as a power of t: the edge of flutter"
    if code == GYROSCOPIC:
        which = [str(i) for i in np.flatnonzero(np.asarray(modes.energy) < 0)]
        have = f"mode {which[0]} has" if len(which) == 1 else f"modes {', '.join(which)} have"
        return (
            f"no mode grows, but {have} negative energy: gyroscopic forces hold what the stiffness does not, and any "
            "damping lets it grow"
        )
    if code == ASYMPTOTIC:
        zero = np.asarray(modes.zero)
        lasting = "; what lasts are zero modes" if np.any(zero) else ""
        return f"every mode decays, the slowest by a factor e in {-1 / np.max(growth[~zero]):.4g}{lasting}"
    if kind.conservative:
        return "all that oscillates has positive energy, which is conserved"
    return "no mode grows, and not all decay"


def label_of(i: int, modes) -> str:
    """A mode in a few words."""
    linearisation, shape = modes.linearisation, np.abs(_flat(modes)[i])
    moved = [linearisation.names[j] for j in np.argsort(-shape.round(6), kind="stable") if shape[j] > NAMED_ABOVE]
    named = ", ".join(moved[:4]) + (", ..." if len(moved) > 4 else "")
    if bool(modes.zero[i]):
        if modes.zero_words and modes.zero_words[i]:
            return f"zero: {modes.zero_words[i]}"
        shifted = len(moved) == 1 and moved[0] in linearisation.shifts
        return f"zero: any {named} and any speed in it will do" if shifted else f"zero: along {named}"
    growth, frequency = float(modes.growth[i]), float(modes.frequency[i])
    words = "swings" if frequency else ("grows" if growth > 0 else "decays")
    if frequency and bool(modes.growing[i]):
        words = "swings and grows"
    elif frequency and growth < 0:
        words = "swings and decays"
    if int(modes.energy[i]) < 0:
        words += ", negative energy"
    if bool(modes.double[i]):
        words += ", double root"
    return f"{words}: {named}"


def _flat(modes):
    """The shapes as (k, N)."""
    leaves = [np.asarray(x) for x in jax.tree.leaves(modes.shapes)]
    return np.concatenate([x.reshape(len(x), -1) for x in leaves], axis=1)
