"""A second computation of the woodpecker toy that shares nothing with lagjax.

Each mode of each of the three contacts is a linear equation z' = A z, z = (q, q', 1), solved by exponentials of A; its
guards are evaluated every `STEP`, their zeros then found by Brent's method, and impacts solved by trying their modes.
"""

from typing import NamedTuple

import numpy as np
from scipy import linalg, optimize

from lagjax.scenes.woodpecker import RESTITUTION

STEP = 2e-5


class Change(NamedTuple):
    """A change of the mode: when, why, to which mode (contact, side), and the state after it."""

    t: float
    why: str
    to: tuple
    z: np.ndarray


class Toy:
    """The equations with given parameters; `impact_mu` is the coefficient of friction in impacts."""

    def __init__(self, p, impact_mu=None):
        self.mu, self.impact_mu = p["mu"], p["mu"] if impact_mu is None else impact_mu
        m, l, r, c = p["m_S"], p["l_M"], p["l_G"], p["c"]
        mass = np.array([
            [m + p["m_M"], m * l, m * r],
            [m * l, p["J_M"] + m * l**2, m * l * r],
            [m * r, m * l * r, p["J_S"] + m * r**2],
        ])  # fmt: skip
        self.inverse = np.linalg.inv(mass)
        spring = np.array([[0, 0, 0], [0, -c, c], [0, c, -c]])
        weight = -p["g"] * np.array([[m + p["m_M"]], [m * l], [m * r]])
        self.force = np.hstack([spring, np.zeros((3, 3)), weight])
        width = p["r_M"] - p["r_0"]
        self.far = {"beak": l + r - p["l_S"] - p["r_0"], "lower": width, "upper": width}
        heights = {"beak": [0, 0, -p["h_S"]], "lower": [0, p["h_M"], 0], "upper": [0, -p["h_M"], 0]}
        self.normal = {name: np.array(height) for name, height in heights.items()}
        edge = np.array([1, p["r_M"], 0])
        self.along = {"beak": np.array([1, l, r - p["l_S"]]), "lower": edge, "upper": edge}
        self.restitution = {"beak": RESTITUTION, "lower": 0.0, "upper": 0.0}
        self.known = {}

    def mode(self, contact, side):
        """A, the two forces of the contact as rows on z, and the exponential of one step."""
        if (contact, side) not in self.known:
            push, forces = np.zeros((3, 7)), np.zeros((2, 7))
            if contact is not None:
                directions = np.stack([self.normal[contact], self.along[contact]], axis=1)
                # Directions with zero acceleration: both, or only the normal one.
                still = directions if side == 0 else directions[:, :1]
                acts = np.eye(2) if side == 0 else np.array([[1.0], [-side * self.mu]])
                matrix = still.T @ self.inverse @ directions @ acts
                forces = -acts @ np.linalg.solve(matrix, still.T @ self.inverse @ self.force)
                push = directions @ forces
            a = np.zeros((7, 7))
            a[:3, 3:6], a[3:6] = np.eye(3), self.inverse @ (self.force + push)
            self.known[contact, side] = a, forces, linalg.expm(STEP * a)
        return self.known[contact, side]

    def guards(self, contact, side):
        """Functions that are positive as long as a mode lasts."""
        if contact is None:
            return {name: lambda z, name=name: self.far[name] + self.normal[name] @ z[:3] for name in self.far}
        normal, along = self.mode(contact, side)[1]
        leaves = {"leaves": lambda z: normal @ z}
        if side:
            return leaves | {"stops": lambda z: side * (self.along[contact] @ z[3:6])}
        cone = {"rises": 1, "slides": -1}
        return leaves | {name: lambda z, s=s: (self.mu * normal + s * along) @ z for name, s in cone.items()}

    def hit(self, contact, z):
        """The state after an impact, and the side to which it slides, from the mode that the impact laws allow."""
        both = np.stack([self.normal[contact], self.along[contact]], axis=1)
        before = both.T @ z[3:6]
        for side in (0, 1, -1):
            acts = np.eye(2) if side == 0 else np.array([[1.0], [-side * self.impact_mu]])
            change = -np.array([(1 + self.restitution[contact]) * before[0], before[1]])[: acts.shape[1]]
            impulse = acts @ np.linalg.solve((both.T @ self.inverse @ both @ acts)[: acts.shape[1]], change)
            u = z[3:6] + self.inverse @ both @ impulse
            inside = abs(impulse[1]) <= self.impact_mu * impulse[0]
            if inside if side == 0 else impulse[0] > 0 and side * (both[:, 1] @ u) > 0:
                return np.concatenate([z[:3], u, [1.0]]), side
        raise AssertionError("an impact without a solution")

    def closed(self, contact, side, z):
        """The mode of a closed contact that slides to a side, or sticks."""
        if side == 0:
            normal, along = self.mode(contact, 0)[1] @ z
            if normal > 0 and abs(along) <= self.mu * normal:
                return contact, 0
            side = 1 if along < 0 else -1
        return (contact, side) if self.mode(contact, side)[1][0] @ z > 0 else (None, 0)

    def next(self, mode, z, until) -> Change | None:
        """The next change of a mode."""
        a, guards, exact = self.mode(*mode)[0], self.guards(*mode), self.mode(*mode)[2]
        before = {name: guard(z) for name, guard in guards.items()}
        for k in range(int(until / STEP)):
            after = exact @ z
            # The guard of a contact that has just opened or closed is zero.
            crossed = [name for name, guard in guards.items() if guard(after) < 0 and (k or before[name] > 1e-15)]
            if crossed:
                root = lambda name: optimize.brentq(
                    lambda t: guards[name](linalg.expm(a * t) @ z), 0.0, STEP, xtol=1e-18, rtol=1e-15
                )
                when, why = min((float(np.asarray(root(name))), name) for name in crossed)
                return self.changed(mode, k * STEP + when, why, linalg.expm(a * when) @ z)
            z = after
        return None

    def changed(self, mode, t, why, z):
        """The mode after a guard reaches zero."""
        if why in self.normal:
            z, side = self.hit(why, z)
            return Change(t, why, (None, 0) if self.restitution[why] else self.closed(why, side, z), z)
        if why == "leaves":
            return Change(t, why, (None, 0), z)
        if why == "stops":
            return Change(t, why, self.closed(mode[0], 0, z), z)
        return Change(t, why, (mode[0], 1 if why == "rises" else -1), z)


def changes(p, turn, slips=2, impact_mu=None) -> list[Change]:
    """All changes of the jammed toy from where its bird turns until it has slipped `slips` times."""
    toy, mode, t, found = Toy(p, impact_mu), ("lower", 0), 0.0, []
    z = np.array([0.0, -(p["r_M"] - p["r_0"]) / p["h_M"], turn, 0.0, 0.0, 0.0, 1.0])
    while sum(change.why == "slides" for change in found) < slips:
        change = toy.next(mode, z, 0.5)
        assert change is not None
        t, mode, z = t + change.t, change.to, change.z
        found.append(change._replace(t=t))
    return found


def lap(p, turn, impact_mu=None) -> tuple[float, float]:
    """The time between two slips, and the speed that the bird gains."""
    first, *_, last = [change for change in changes(p, turn, 2, impact_mu) if change.why == "slides"]
    return last.t - first.t, last.z[5] - first.z[5]
