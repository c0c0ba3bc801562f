"""What the roots say of a system, in words."""

import jax
import numpy as np

from lagjax.analysis.motions import ASYMPTOTIC, DIVERGENCE, FLUTTER, GYROSCOPIC, STABLE, UNDECIDED, UNSTEADY

VERDICTS = {
    STABLE: "stable",
    ASYMPTOTIC: "asymptotically stable",
    GYROSCOPIC: "gyroscopically stabilised",
    DIVERGENCE: "divergence",
    FLUTTER: "flutter",
    UNDECIDED: "undecided",
    UNSTEADY: "no steady motion",
}
# Entries of a shape below this part of the largest are not named.
NAMED_ABOVE = 1e-6


def reason_of(modes) -> str:
    """Why the verdict is what it is, in one sentence."""
    code, kind = int(modes.code), modes.linearisation.kind
    growth = np.asarray(modes.growth)
    worst = int(np.argmax(growth)) if growth.size else 0
    if code == UNSTEADY:
        return (
            f"the state is none of equilibrium (residual {float(modes.linearisation.residual):.2g}), or its mass matrix "
            "is singular"
        )
    if code == DIVERGENCE:
        return f"mode {worst} grows by a factor e in {1 / growth[worst]:.4g}, without swinging"
    if code == FLUTTER:
        return f"mode {worst} swings and grows by a factor e in {1 / growth[worst]:.4g}"
    if code == UNDECIDED:
        if np.any(np.asarray(modes.zero) & ~_of_shifts(modes)) and int(modes.unexplained):
            return (
                "a root of zero that no coordinate explains: a symmetry of several coordinates together, or a critical "
                "point, at which terms of higher order decide"
            )
        return "two modes share root and shape, and grow together as a power of t: the edge of flutter"
    if code == GYROSCOPIC:
        which = ", ".join(str(i) for i in np.flatnonzero(np.asarray(modes.energy) < 0))
        return (
            f"no mode grows, but mode{'s' * (',' in which)} {which} {'have' if ',' in which else 'has'} negative energy: "
            "gyroscopic forces hold what the stiffness does not, and any damping lets it grow"
        )
    if code == ASYMPTOTIC:
        lasting = "; what lasts are zero modes" if np.any(np.asarray(modes.zero)) else ""
        return f"every mode decays, the slowest by a factor e in {-1 / np.max(growth[~np.asarray(modes.zero)]):.4g}{lasting}"
    if kind.conservative:
        return "all that oscillates has positive energy, which is conserved"
    return "no mode grows, and not all decay"


def _of_shifts(modes):
    """Which modes only shift a coordinate that nothing depends on."""
    moved = np.abs(_flat(modes)) > NAMED_ABOVE
    return np.asarray(modes.zero) & ~moved[:, ~np.array(modes.linearisation.kind.unseen, bool)].any(axis=1)


def label_of(i: int, modes) -> str:
    """What one mode is, in a few words."""
    linearisation = modes.linearisation
    entries = [name for name, x in zip(linearisation.names, _flat(modes)[i]) if abs(x) > NAMED_ABOVE]
    named = ", ".join(entries[:4]) + (", ..." if len(entries) > 4 else "")
    if bool(modes.zero[i]):
        if bool(_of_shifts(modes)[i]):
            if linearisation.kind.conservative and len(entries) == 1:
                return f"zero: any {named} and any speed in it will do"
            return (
                f"zero: other speeds in {named}" if not linearisation.kind.conservative else f"zero: shift of {named}"
            )
        if not all(linearisation.kind.holonomic):
            return f"zero: shift of {named}, which the velocity constraints leave free"
        return f"zero: along {named}"
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
