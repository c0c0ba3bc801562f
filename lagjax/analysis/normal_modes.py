"""Normal modes: how a system moves near an equilibrium or a steady motion, and whether it stays there.

`eigenmodes.py` has the roots and shapes; here they get a verdict in words, pictures and films. Neutral directions,
shifts to another equilibrium and other speeds of a steady motion, are the vectors y = (positions, velocities) with
A y = 0. LAPACK returns an arbitrary basis of them; it is reduced until each has an entry that is zero in all others.
"""

from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from lagjax.analysis import degenerate
from lagjax.analysis.balance import Steady, SteadySymmetries, side_by_side
from lagjax.analysis.eigenmodes import (
    ASYMPTOTIC,
    DIVERGENCE,
    FLUTTER,
    GYROSCOPIC,
    STABLE,
    UNDECIDED,
    UNSTEADY,
    Motions,
    motions_of,
)
from lagjax.analysis.linearise import Linearisation, linearise, linearised, pencil
from lagjax.display import Animation, plots
from lagjax.integrate import drawn
from lagjax.jaxtools import compiled, is_eager, is_traced
from lagjax.numerics import newton_in_python, null_space
from lagjax.system import Call, check_arguments, coordinates, model_of

# The length of a film in periods, or in times of growth by a factor e.
PERIODS, GROWTHS = 3.0, 3.0


@plots.names_as_they_are()
def drawn_roots(roots: np.ndarray, growing: np.ndarray, zero: np.ndarray):
    """Draw numbered roots in the complex plane; returns a matplotlib `Figure`."""
    fig, axes = plots.figure(size=(5.6, 3.6))
    axis = axes[0, 0]
    axis.axvline(0.0, color="black", linewidth=0.8)
    axis.axhline(0.0, color="black", linewidth=0.8)
    groups = (("grows", growing, 1, 6), ("zero", zero, 6, 2), ("does not grow", ~growing & ~zero, 0, 0))
    for label, which, colour, marker in groups:
        x = roots[which]
        if x.size:
            both = np.concatenate([x, np.conj(x[np.imag(x) > 0])])
            style = {"color": plots.COLOURS[colour], "marker": plots.MARKERS[marker], "markersize": 6}
            axis.plot(np.real(both), np.imag(both), linestyle="", label=label, zorder=3, **style)
    places: dict[tuple, list[str]] = {}
    size = max(float(np.max(np.abs(roots), initial=0.0)), 1e-300)
    for i, root in enumerate(roots):
        places.setdefault((round(root.real / size, 3), round(root.imag / size, 3)), []).append(str(i))
    for (x, y), names in places.items():
        axis.annotate(", ".join(names), (x * size, y * size), (6, 5), textcoords="offset points", fontsize=8)
    reach = 1.15 * size
    axis.set(xlabel="growth [1/t]", ylabel="frequency [rad/t]", ylim=(-reach, reach))
    if np.all(np.abs(np.real(roots)) < 0.05 * size):
        axis.set_xlim(-0.5 * reach, 0.5 * reach)
    axis.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


@plots.names_as_they_are()
def drawn_mode(mode):
    """Draw the amplitude and the motion of each coordinate; returns a matplotlib `Figure`."""
    names = mode.linearisation.names
    shape = np.concatenate([np.ravel(np.asarray(x)) for x in jax.tree.leaves(mode.shape)])
    root = complex(mode.root)
    fig, axes = plots.figure(1, 2, size=(4.2, max(2.4, 0.3 * len(names) + 1.2)))
    bars, curves = axes[0]
    place = np.arange(len(names))[::-1]
    bars.barh(place, np.abs(shape), color=[plots.COLOURS[i % len(plots.COLOURS)] for i in range(len(names))])
    bars.set_yticks(place, names)
    bars.set(xlabel="amplitude, the largest one", title=mode.label, xlim=(0.0, 1.25))
    for y, x in zip(place, shape):
        if abs(x) > 1e-6:
            bars.text(
                abs(x) + 0.02,
                y,
                f"{abs(np.degrees(np.angle(x)).round()):.0f}°"
                if x.imag == 0
                else f"{np.degrees(np.angle(x)).round() + 0:.0f}°",
                va="center",
                fontsize=8,
            )
    t = np.linspace(0.0, _span(root), 241)
    moving = np.exp(root * t)
    for i, x in enumerate(shape):
        if abs(x) > 1e-3:
            curves.plot(t, (x * moving).real, label=names[i], **plots.style(i))
    curves.set(xlabel="t", ylabel="displacement", title=_in_words(root))
    curves.legend(fontsize=8, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    return fig


def _in_words(root):
    return f"growth {root.real:.5g}, frequency {root.imag:.5g}"


def _span(root):
    """The time for which a mode is shown."""
    if abs(root.imag) > 0:
        periods = PERIODS * 2 * np.pi / abs(root.imag)
        return min(periods, GROWTHS / abs(root.real)) if abs(root.real) * periods > 2 * GROWTHS else periods
    return GROWTHS / abs(root.real) if root.real else 1.0


def _count(seconds: float, rate: float, trail: float, who: str) -> int:
    """How many frames a film has; raise if it is none."""
    count = round(seconds * rate) + 1 if np.isfinite(seconds * rate) else 0
    if count < 3 or not trail >= 0:
        raise ValueError(
            f"seconds = {seconds:g} at rate = {rate:g} frames a second, with a trail of {trail:g} s, is not a film.\n"
            f"Fix: {who}.animate(positions, seconds=6.0), and a trail of zero or more seconds."
        )
    return count


def animated(mode, positions: Callable, amplitude: float, seconds: float, rate: float, trail: float) -> Animation:
    """A film of the motion with a mode of this amplitude added."""
    check_arguments(Call("positions", positions, ("t", "q", "params")), "an argument left out that is not needed")
    count = _count(seconds, rate, trail, "mode")
    t = np.linspace(0.0, _span(complex(mode.root)), count)
    return Animation(float(mode.linearisation.state.t) + t, _played(mode, positions, amplitude, t), rate,
                     int(min(trail * rate, count)))  # fmt: skip


def _played(mode, positions: Callable, amplitude: float, t: np.ndarray) -> dict[str, np.ndarray]:
    """What is drawn of the motion with a mode added, at times t from its start."""
    s, root = mode.linearisation.state, complex(mode.root)
    growing = np.exp(root * t)
    growing = amplitude * growing / np.max(np.abs(growing))
    if root == 0:
        # A shift is shown as one oscillation.
        growing = amplitude * np.sin(2 * np.pi * t / t[-1]).astype(complex)
    x, u, shape = (np.asarray(coordinates.vector(tree)) for tree in (s.q, s.v, mode.shape))
    path = x + t[:, None] * u + np.real(growing[:, None] * shape)
    return drawn(positions, float(s.t) + t, coordinates.like(s.q, path), s.params)


# In a film of all modes the fastest has at most so many periods: more are a blur.
MOST_PERIODS = 20.0


def animated_together(
    modes, positions: Callable, amplitude: float, seconds: float, rate: float, trail: float
) -> Animation:
    """A film of all modes, one to the right of the other, in one time."""
    check_arguments(Call("positions", positions, ("t", "q", "params")), "an argument left out that is not needed")
    count = _count(seconds, rate, trail, "modes")
    periods = [2 * np.pi / x for x in np.asarray(modes.frequency) if x > 0]
    spans = [_span(complex(mode.root)) for mode in modes if complex(mode.root) != 0] or [1.0]
    t = np.linspace(0.0, min(max(spans), MOST_PERIODS * min(periods, default=np.inf)), count)
    found, right = {}, 0.0
    for i, mode in enumerate(modes):
        points = _played(mode, positions, amplitude, t)
        every = np.concatenate([x.reshape(-1, x.shape[-1]) for x in points.values()])
        low, high = every.min(axis=0), every.max(axis=0)
        # A fifth of its largest extent between two of them.
        away = np.zeros(len(low))
        away[0] = right - low[0]
        right += high[0] - low[0] + 0.2 * max(np.max(high - low), 1e-12)
        root = complex(mode.root)
        words = f"{i}: " + (f"frequency {root.imag:.4g}" if root.imag and not root.real else mode.label)
        found |= {words + (f", {name}" if name else ""): x + away for name, x in points.items()}
    return Animation(float(modes.linearisation.state.t) + t, found, rate, int(min(trail * rate, count)))


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
    linearisation, shape = modes.linearisation, np.abs(side_by_side(modes.shapes)[i])
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


ZERO_BELOW = 1e-9
NEWTON_STEPS, STEADY_AFTER = 8, 1e-9


def with_neutral(linearisation, shapes, zero):
    """The shapes (k, N), with those of zero roots replaced by a reduced basis; and a description of each zero root.

    There may be fewer neutral directions than zero roots; the remaining roots are motions along them that grow with
    time.
    """
    words = [""] * len(zero)
    if not np.any(zero):
        return shapes, words
    p, kind = jax.tree.map(np.asarray, linearisation.parts), linearisation.kind
    A = pencil(p, np)[1]
    # Rows have different units, so each is scaled by its largest entry.
    size = np.max(np.abs(A), axis=1, keepdims=True)
    basis = null_space(A / np.where(size > 0, size, 1.0), ZERO_BELOW).T
    count = p.drift.shape[0]
    # A direction with a displacement is described by it, one without a displacement by its velocities.
    still = basis[:, :count] @ p.positions.T
    moving = basis[:, count:] @ p.velocities.T + basis[:, :count] @ p.turning.T
    reduced = _reduced(np.concatenate([still, moving], axis=1))
    shapes, n = np.array(shapes), shapes.shape[1]
    for i, row in zip(np.flatnonzero(zero), reduced):
        shifts = np.max(np.abs(row[:n])) > 1e-6
        row = row[:n] if shifts else row[n:]
        shapes[i] = row / row[np.argmax(np.abs(row))]
        moved = _listed(linearisation.names, shapes[i])
        if not shifts:
            words[i] = f"other speeds in {moved}"
        elif all(kind.holonomic):
            words[i] = f"along {moved}"
        else:
            words[i] = f"shift of {moved}, which the velocity constraints leave free"
    for i in np.flatnonzero(zero)[len(reduced) :]:
        words[i] = "a shift or a speed named before, growing with time"
    return shapes, words


def leads_to_others(linearisation, shapes, linearised_at) -> bool:
    """Whether other equilibria lie along each of the zero `shapes` (k, N): a symmetry, not a critical point.

    From points displaced along each shape, Newton's method looks for an equilibrium in the directions across all
    shapes. `linearised_at(x)`: the `Linearisation` at other positions.
    """
    start = np.concatenate([np.ravel(x) for x in jax.tree.leaves(linearisation.state.q)])
    P = np.asarray(linearisation.parts.positions)
    along = np.linalg.qr(np.linalg.pinv(P) @ np.real(shapes).T)[0]
    across = null_space(along.T)
    size = np.max(np.abs(start)) or 1.0

    def step(x):
        now = linearised_at(x)
        return -_step(now, across) if now.sound else None

    for displaced in (start + share * size * shape for shape in np.real(shapes) for share in (0.2, -0.2)):
        found = newton_in_python(step, displaced, NEWTON_STEPS)
        if found is None or not linearised_at(found.y).residual <= STEADY_AFTER:
            return False
    return True


def _step(now, across):
    """The Newton step to an equilibrium on the constraints, restricted to the directions `across`."""
    p, holonomic = now.parts, np.array(now.kind.holonomic, bool)
    P, V, mass, K = (np.asarray(x) for x in (p.positions, p.velocities, p.mass, p.position))
    force = mass @ np.linalg.pinv(V) @ np.asarray(p.a)
    step = P @ across @ np.linalg.pinv(K @ across) @ force if across.shape[1] else np.zeros(len(P))
    rows, off = np.asarray(p.raw.rows)[holonomic], np.asarray(p.off)[: int(holonomic.sum())]
    return step - np.linalg.pinv(rows) @ off if len(rows) else step


def _listed(names, shape):
    entries = [name for name, x in zip(names, shape) if abs(x) > 1e-6]
    return ", ".join(entries[:4]) + (", ..." if len(entries) > 4 else "")


def _reduced(rows):
    """Gauss-Jordan elimination with full pivoting."""
    rows, done = np.array(rows), []
    for i in range(len(rows)):
        left = np.abs(rows)
        left[done] = 0.0
        k, j = np.unravel_index(int(np.argmax(left)), left.shape)
        rows[k] /= rows[k, j]
        others = np.arange(len(rows)) != k
        rows[others] -= np.outer(rows[others, j], rows[k])
        done.append(k)
    rows[np.abs(rows) < 1e-12] = 0.0
    return rows


class Mode(eqx.Module):
    """One small motion, `Re(shape · exp(root · t))` times an arbitrary factor.

    - `root`: growth + i frequency, `[1/t]`. `shape`: like q, complex, its largest entry is one.
    - `energy`: its sign, 0 if the mode does not oscillate steadily or the system is not conservative.
    - `double`: another mode has the same root.
    """

    root: Complex[Array, ""]
    shape: PyTree[Complex[Array, "..."]]
    energy: Int[Array, ""]
    double: Bool[Array, ""]
    linearisation: Linearisation
    label: str = eqx.field(static=True)

    @property
    def frequency(self) -> Float[Array, ""]:
        """The frequency in radians per unit of time."""
        return jnp.imag(self.root)

    @property
    def growth(self) -> Float[Array, ""]:
        """The rate at which the logarithm of the amplitude grows, per unit of time."""
        return jnp.real(self.root)

    def plot(self):
        """Plot the amplitude and phase of each coordinate, and the motion; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib.
        """
        return drawn_mode(self)

    def animate(self, positions, *, amplitude=0.2, seconds: float = 6.0, rate: float = 25.0, trail: float = 0.0):
        """Play the mode: points in the plane or in space, as `Trajectory.animate` draws them.

        **Arguments:** `positions(t, q, params)` -> points, see `Trajectory.animate`; `amplitude`: the
        amplitude of the coordinate that moves most, `[q]`; `seconds`, `rate`, `trail`: of the film.

        **Returns:** an `Animation` of a few periods on top of the steady motion; for a mode that grows or decays, of a
        few times the time in which it does so by a factor e.

        **Raises:** `ValueError` for positions that are not points.
        """
        return animated(self, positions, amplitude, seconds, rate, trail)

    def __repr__(self):
        return f"Mode(root = {complex(self.root):.6g}; {self.label})"


class NormalModes(eqx.Module):
    """The small motions about a steady one, by ascending frequency. They print and plot themselves; `modes[i]` is one.

    - `roots` (k,): growth + i frequency of each, `[1/t]`; `frequency`, `growth`: their parts. Two roots that describe
      the same motion (conjugates; in a conservative system also λ and -λ) are listed once. While JAX is tracing, all
      roots of a non-conservative system are listed, those of negative frequency last.
    - `shapes`: like q, complex, with a leading axis k; the largest entry of each is one.
    - `energy` (k,): the sign of the energy of each steadily oscillating mode; 0 for the others.
    - `zero` (k,): whether the root is zero. `growing` (k,): whether the mode grows. `double` (k,): whether another root
      is the same; its derivatives are then those of the mean of both, or zero if both share their shape.
    - `code`, `stable`: the `verdict` as a number (its index in `NormalModes.VERDICTS`), and whether nothing grows.
    - `unexplained`: how many zero roots may be those of a critical point. Outside of compiled programs, those that lead
      to other equilibria are not counted.
    - `linearisation`: the `Linearisation` that has these modes.

    `roots` have first and second derivatives, `shapes` first derivatives.
    """

    roots: Complex[Array, " k"]
    shapes: PyTree[Complex[Array, "k ..."]]
    energy: Int[Array, " k"]
    zero: Bool[Array, " k"]
    growing: Bool[Array, " k"]
    double: Bool[Array, " k"]
    code: Int[Array, ""]
    unexplained: Int[Array, ""]
    linearisation: Linearisation
    zero_words: tuple[str, ...] = eqx.field(static=True, default=())

    VERDICTS: ClassVar[tuple[str, ...]] = tuple(VERDICTS.values())

    @property
    def frequency(self) -> Float[Array, " k"]:
        """The frequency of each mode in radians per unit of time."""
        return jnp.imag(self.roots)

    @property
    def growth(self) -> Float[Array, " k"]:
        """The rate at which the logarithm of each mode's amplitude grows, per unit of time."""
        return jnp.real(self.roots)

    @property
    def stable(self) -> Bool[Array, ""]:
        """Whether no small motion grows; along zero modes a shift persists."""
        return self.code <= GYROSCOPIC

    @property
    def verdict(self) -> str:
        """What the system does near this motion."""
        return VERDICTS[int(self.code)]

    @property
    def reason(self) -> str:
        """The reason for the verdict, in one sentence."""
        return reason_of(self)

    def __len__(self):
        return len(self.roots)

    def __getitem__(self, i: int) -> Mode:
        if not -len(self) <= i < len(self):
            raise IndexError(f"there are {len(self)} modes, modes[0] to modes[{len(self) - 1}].")
        shape = jax.tree.map(lambda x: x[i], self.shapes)
        label = "" if is_traced(self.roots) else label_of(i % len(self), self)
        return Mode(self.roots[i], shape, self.energy[i], self.double[i], self.linearisation, label)

    def animate(self, positions, *, amplitude=0.2, seconds: float = 10.0, rate: float = 25.0, trail: float = 0.0):
        """Play all modes side by side, in one time, the first on the left; `modes[i].animate(...)` plays one.

        **Arguments:** as for a single `Mode`; the film takes three periods of the slowest mode, or twenty of the
        fastest. x of each is that of `positions`, moved to the right.

        **Returns:** an `Animation`, in the colours and words of the modes.

        **Raises:** `ValueError` for positions that are not points.
        """
        return animated_together(self, positions, amplitude, seconds, rate, trail)

    def plot(self):
        """Plot all roots, growth to the right and frequency upward; returns a matplotlib `Figure`.

        **Raises:** `ImportError` without matplotlib.
        """
        return drawn_roots(np.asarray(self.roots, complex), np.asarray(self.growing), np.asarray(self.zero))

    def __repr__(self):
        if is_traced(self.roots) or np.ndim(self.code):
            return f"NormalModes of shape {np.shape(self.roots)}"
        rows = [f"{len(self)} mode{'s' * (len(self) > 1)}: {self.verdict}", f"  {self.reason}"]
        for i in range(len(self)):
            values = (
                ""
                if self.zero[i]
                else f"frequency {float(self.frequency[i]):<12.8g} growth {float(self.growth[i]):<12.6g}"
            )
            rows.append(f"  {i}  {values:<46}{label_of(i, self)}")
        if np.any(np.asarray(self.double) & ~np.asarray(self.zero)):
            rows.append("  double roots: their derivatives are those of the mean, or zero where they share a shape")
        if self.roots.dtype == np.complex64 and len(self):
            known = 1e2 * np.finfo(np.float32).eps * float(np.max(np.abs(self.roots)))
            rows.append(f"  in float32: values below {known:.1e} cannot be distinguished from zero")
        residual = float(self.linearisation.residual)
        if residual > 1e-10:
            rows.append(f"  the state is steady to {residual:.1e} of its size: the roots are as accurate")
        return "\n".join(rows)


def normal_modes(system, t=None, q: PyTree = None, v: PyTree = None, params: PyTree = None) -> NormalModes:
    """Return the modes of small motions about an equilibrium or a steady motion, and whether they stay small.

    >>> import jax.numpy as jnp
    >>> import lagjax as lj
    >>> def bead(t, q, v, params):
    ...     turning = 0.5 * (params["omega"] * jnp.sin(q)) ** 2
    ...     return 0.5 * v**2 + turning + params["g"] * jnp.cos(q)
    >>> system = lj.System(bead)
    >>> normal_modes(system, 0.0, 0.0, 0.0, {"omega": 2.0, "g": 20.0})
    1 mode: stable
      all that oscillates has positive energy, which is conserved
      0  frequency 4            growth 0           swings: q
    >>> print(normal_modes(system, 0.0, 0.0, 0.0, {"omega": 5.0, "g": 9.0}).verdict)
    divergence

    **Arguments:** as for `lj.linearise`; or a `Linearisation` alone.

    **Returns:** `NormalModes`.

    **Raises:** as `lj.linearise`.

    Source: Goldstein, *Classical Mechanics*, §6.2-6.3; Meirovitch, *Methods of Analytical Dynamics*, §6 and §9;
    Kirillov, *Nonconservative Stability Problems of Modern Physics*, ch. 3 and 5.
    """
    linearisation = system if isinstance(system, Linearisation) else linearise(system, t, q, v, params)
    motions = _motions(linearisation, True)
    if not is_eager() or is_traced(motions):
        return _collected(linearisation, motions)
    if not np.all(np.isfinite(motions.roots)):
        # The mass matrix is regular but not positive definite.
        motions = _motions(linearisation, False)
    kept = ~np.asarray(motions.mirrored)
    of_modes = jax.tree.map(lambda x: np.asarray(x)[kept] if np.ndim(x) else np.asarray(x), motions)
    words = []
    if not linearisation.kind.conservative:
        shapes, words = with_neutral(linearisation, of_modes.shapes, of_modes.zero)
        of_modes = of_modes._replace(shapes=shapes)
    if int(of_modes.code) == UNDECIDED and int(of_modes.unexplained) and not isinstance(system, Linearisation):
        of_modes = _with_symmetries(system, linearisation, of_modes)
    return _collected(linearisation, of_modes, tuple(words))


def _with_symmetries(system, linearisation, motions: Motions) -> Motions:
    """The motions, with a verdict if the zero modes lead to other equilibria, or if a term of higher order decides."""
    unseen = np.array(linearisation.kind.unseen, bool)
    explained = np.all(np.abs(motions.shapes[:, ~unseen]) <= 1e-6, axis=1)
    s = linearisation.state
    model, dtype = model_of(system, *s), linearisation.mass.dtype

    def at(x: Array):
        return linearised(linearisation.kind, model, s._replace(q=model.tree(jnp.asarray(x, dtype))))

    if not leads_to_others(linearisation, motions.shapes[motions.zero & ~explained], at):
        verdict = _by_first_term(system, linearisation)
        if verdict == degenerate.UNSTABLE:
            return motions._replace(code=np.asarray(DIVERGENCE, motions.code.dtype))
        if verdict != degenerate.STABLE:
            return motions
    lasting = ~motions.zero
    decays = not linearisation.kind.conservative and bool(np.all(motions.roots.real[lasting] < 0))
    code = ASYMPTOTIC if decays else GYROSCOPIC if np.any(motions.energies < 0) else STABLE
    return motions._replace(code=np.asarray(code, motions.code.dtype), unexplained=np.zeros_like(motions.unexplained))


def _by_first_term(system, linearisation) -> int:
    """The verdict of the first term that does not vanish along the zero mode, for rest or motion along shifts."""
    s, unseen = linearisation.state, np.array(linearisation.kind.unseen, bool)
    x, u = (np.asarray(coordinates.vector(tree)) for tree in (s.q, s.v))
    if np.any(u[~unseen]):
        return degenerate.UNDECIDED
    places = tuple(int(i) for i in np.flatnonzero(u))
    symmetries = SteadySymmetries(places=places)
    steady = Steady(model_of(system, *s), s.t, u[list(places)], x, symmetries)
    multipliers = np.concatenate([np.ravel(y) for y in jax.tree.leaves(linearisation.multipliers)] or [u[:0]])
    y = np.concatenate([x, u[list(places)], multipliers])
    unseen[list(places)] = False
    steady = degenerate.held_by_momentum(steady, x, u[list(places)])
    roots = np.asarray(linearisation.eigenvalues())
    return degenerate.decide(steady, y, float(np.max(np.abs(x), initial=0.0)), roots, unseen).verdict


_motions = compiled(motions_of)


def _collected(linearisation, motions: Motions, zero_words=()) -> NormalModes:
    shapes, start = [], 0
    for leaf in jax.tree.leaves(linearisation.state.q):
        size = int(np.size(leaf))
        shapes.append(motions.shapes[:, start : start + size].reshape(-1, *np.shape(leaf)))
        start += size
    return NormalModes(
        roots=motions.roots,
        shapes=jax.tree.unflatten(jax.tree.structure(linearisation.state.q), shapes),
        energy=motions.energies,
        zero=motions.zero,
        growing=motions.growing,
        double=motions.double,
        code=motions.code,
        unexplained=motions.unexplained,
        linearisation=linearisation,
        zero_words=zero_words,
    )
