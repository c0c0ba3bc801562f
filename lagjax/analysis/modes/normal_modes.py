"""Normal modes: how a system moves near an equilibrium or a steady motion, and whether it stays there."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int, PyTree

from lagjax.analysis.equilibria import degenerate
from lagjax.analysis.equilibria.balance import Steady, SteadySymmetries
from lagjax.analysis.modes.eigenmodes import ASYMPTOTIC, DIVERGENCE, GYROSCOPIC, STABLE, UNDECIDED, Motions, motions_of
from lagjax.analysis.modes.linearise import Linearisation, linearise, linearised
from lagjax.analysis.modes.plots import animated, drawn_mode, drawn_roots
from lagjax.analysis.modes.words import VERDICTS, label_of, reason_of
from lagjax.analysis.modes.zero_modes import leads_to_others, with_neutral
from lagjax.jaxtools.compiled import compiled
from lagjax.jaxtools.tracing import is_eager, is_traced
from lagjax.system import coordinates
from lagjax.system.model import model_of


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
        """Play the mode: points in the plane, as `Trajectory.animate` draws them.

        **Arguments:** `positions(t, q, params)` -> points, see `lj.Trajectory.animate`; `amplitude`: the
        amplitude of the coordinate that moves most, `[q]`; `seconds`, `rate`, `trail`: of the film.

        **Returns:** an `Animation` of a few periods on top of the steady motion; for a mode that grows or decays, of a
        few times the time in which it does so by a factor e.

        **Raises:** `ValueError` for positions that are not points of the plane.
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
    - `code`, `stable`: the `verdict` as a number (its index in `lj.NormalModes.VERDICTS`), and whether nothing grows.
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


def normal_modes(system, t=None, q=None, v=None, params=None) -> NormalModes:
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
    at = lambda x: linearised(linearisation.kind, model, s._replace(q=model.tree(jnp.asarray(x, dtype))))
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


@compiled
def _motions(linearisation: Linearisation, definite: bool) -> Motions:
    return motions_of(linearisation, definite)


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
