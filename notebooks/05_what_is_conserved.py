# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # What is conserved?
#
# Every symmetry of a Lagrangian conserves something (Noether): a translation a component of momentum, a rotation one of
# angular momentum, time the energy. Which symmetries does a system have? `lj.symmetries` finds them, `lj.is_symmetry`
# tests a claimed one, and `lj.noether_charge` gives the conserved quantity as a function of the state.
#
# We start with the particle of Goldstein's Exercise 2-19, which falls through the gravitational field of a fixed mass
# distribution. Per unit of its mass, $L = \frac{1}{2}|\mathbf v|^2 - \Phi(\mathbf q)$. Seven potentials $\Phi$, of a
# plane, a half plane, a circular cylinder, infinite or finite, an elliptic cylinder, a dumbbell and a helix, are in
# `lagjax.scenes`. Units here: $G = 1$.

# %%
import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import cross_rails as rails
from lagjax.scenes import mass_distributions as masses
from lagjax.scenes import potentials
from lagjax.scenes import sliding_wedge as wedge

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def in_the_field_of(potential):
    def lagrangian(t, q, v, params):
        return 0.5 * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2) - potential(q, params)

    lagrangian.__name__ = potential.__name__
    return lj.System(lagrangian)


systems = {name: in_the_field_of(potential) for name, potential in masses.POTENTIALS.items()}
params = masses.PARAMS | {"helix": masses.PARAMS["helix"] | {"h": 1.7}}

# %% [markdown]
# ## Symmetries, found
#
# `lj.symmetries` has a basis of transformations (shifts, rotations, boosts, time). At many states around a given one it
# computes the rate at which the charge of each would change. The symmetries are the combinations for which all rates
# vanish: a null space. The gap in the singular values says how certain it is.

# %%
found = {name: lj.symmetries(systems[name], *masses.ORBITS[name][:2], params[name]) for name in systems}
for name in ("plane", "helix"):
    print(found[name], "\n")

# %% [markdown]
# The helix has a screw symmetry: turn it by an angle $\varepsilon$ and it looks displaced along $z$ by
# $h\varepsilon/2\pi$, with $h$ its pitch. The conserved quantity is $h\,p_z + 2\pi L_z$. (The solution that this
# notebook follows speaks of a translation by $h$ with a rotation by $2\pi$, and prints $h\,p_z + L_z$. But a rotation
# by $2\pi$ does nothing at all, and a translation by $h$ alone is a discrete step, not a continuous motion: it
# conserves nothing.)
#
# The table shows the constants of all seven, and how much each changes on an orbit without any symmetry of its own,
# relative to its largest value:

# %%
G = lj.Generator
# The potentials are long: diffrax's own loop over the stages compiles faster than lagjax's unrolled one.
settings = {"rtol": 1e-9, "atol": 1e-9, "method": diffrax.Dopri8()}
generators = {f"p_{axis}": G.translation(axis) for axis in "xyz"} | {f"L_{axis}": G.rotation(axis) for axis in "xyz"}
generators["E"] = G.time_translation()
changes, orbits = {}, {}
for name, system in systems.items():
    q, v, duration = masses.ORBITS[name]
    orbit = orbits[name] = lj.integrate(system, q, v, params[name], ts=jnp.linspace(0.0, duration, 41), **settings)
    charges = {key: lj.noether_charge(system, generator) for key, generator in generators.items()}
    if name == "helix":
        charges["screw"] = lj.noether_charge(system, G.screw("z", params["helix"]["h"]))
    at = lambda t, q, v: {key: charge(t, q, v, params[name]) for key, charge in charges.items()}
    along = jax.jit(jax.vmap(at))(orbit.t, orbit.q, orbit.v)
    changes[name] = {key: masses.drift(values) for key, values in along.items()}

columns = (*generators, "screw")
table = np.array([[row.get(key, np.nan) for key in columns] for row in changes.values()])
fig, axes = plot.figure(size=(7.2, 3.6))
axis = axes[0, 0]
axis.imshow(np.where(table < 1e-6, 0.0, 1.0), cmap="cividis", vmin=-0.2, vmax=1.4, aspect="auto")
for i, row in enumerate(table):
    for k, value in enumerate(row):
        kept = value < 1e-6
        words = "" if np.isnan(value) else "constant" if kept else f"{value:.2g}"
        axis.text(k, i, words, ha="center", va="center", fontsize=8, color="white" if kept else "black")
axis.set_xticks(range(len(columns)), [f"${key}$" for key in columns[:-1]] + ["screw"])
axis.set_yticks(range(len(table)), list(changes))
axis.set_title("Largest change along the orbit, relative to the largest value")
axis.grid(False)
fig

# %% [markdown]
# "Constant" means a change below $10^{-6}$, the error of the integration; everything else changes by 4 % or more. This
# agrees with the symmetries found. Two remarks on the list that the solution gives:
#
# - The half plane's force is infinite. The solution treats it like the rest. A strip of the width $W$ pulls along $y$
#   with $2 G\sigma\ln W$, which has no limit for $W \to \infty$; without this uniform pull the rest has a limit, and
#   the symmetry of the half plane.
# - $E$ belongs to the list everywhere: "only $p_x$", as the solution says, is $p_x$ and $E$. And along a direction of
#   free flight a boost conserves $t\,p_x - x$, the place where the particle was at $t = 0$.

# %%
half = params["half plane"]
point = masses.vector(0.0, 1.25, 0.5)
limit = potentials.gradient(potentials.half_plane, point, half)["y"]
fields = {}
for power in (10, 20, 40):
    width = 2.0**power
    whole = potentials.gradient(potentials.strip, point, half | {"width": width})["y"]
    fields[power] = float(whole), float(whole + 2 * half["G"] * half["sigma"] * np.log(width))
    print(
        f"W = 2^{power}: dPhi/dy = {fields[power][0]:9.4f}; without the pull {fields[power][1]:.6f}, limit {limit:.6f}"
    )

# %% [markdown]
# ## Testing a claim
#
# Is the printed combination conserved? No, and `is_symmetry` says how fast it changes at the state that it was given:
# the rate follows from the missing symmetry. Integrated along the orbit, it gives the change itself.

# %%
q, v, duration = masses.ORBITS["helix"]
h = params["helix"]["h"]
claims = {
    "$h\\,p_z + 2\\pi L_z$": G.screw("z", h),
    "$h\\,p_z + L_z$, as printed": h * G.translation("z") + G.rotation("z"),
    "$p_z$": G.translation("z"),
    "$L_z$": G.rotation("z"),
}
tests = {
    label: lj.is_symmetry(systems["helix"], generator, q, v, params["helix"]) for label, generator in claims.items()
}
print(tests["$h\\,p_z + L_z$, as printed"])

orbit, predicted, moved = orbits["helix"], {}, {}
fig, axes = plot.figure(size=(6.0, 3.4))
axis = axes[0, 0]
for i, (label, generator) in enumerate(claims.items()):
    charge = lj.noether_charge(systems["helix"], generator)
    both = lambda t, q, v: (charge(t, q, v, params["helix"]), charge.rate(t, q, v, params["helix"]))
    values, rates = (np.asarray(x) for x in jax.jit(jax.vmap(both))(orbit.t, orbit.q, orbit.v))
    steps = np.diff(orbit.t) * 0.5 * (rates[1:] + rates[:-1])
    predicted[label], moved[label] = np.concatenate([[0.0], np.cumsum(steps)]), values - values[0]
    axis.plot(orbit.t, moved[label], label=label, **plot.style(i))
    axis.plot(orbit.t[::4], predicted[label][::4], "o", markersize=4, color=plot.COLOURS[i])
axis.set(xlabel="t", ylabel="change since t = 0", title=f"Around the helix (h = {h}); dots: predicted from the rate")
axis.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# ### Find the factor from the potential
#
# For which $f$ is $h\,p_z + f L_z$ a symmetry? This is a sweep over the pitch $h$, including left-handed helices with
# $h < 0$. The residual of the test answers it, without any orbit.


# %%
def residual(point):
    claim = point["h"] * G.translation("z") + point["f"] * G.rotation("z")
    return lj.is_symmetry(systems["helix"], claim, q, v, params["helix"] | {"h": point["h"]}).residual


pitches, factors = np.array([-3.0, -1.0, 1.0, 2.0, 4.0]), np.append(np.linspace(0.5, 7.5, 15), 2 * np.pi)
swept = lj.sweep(residual, {"h": pitches, "f": np.sort(factors)}, progress=False)
fig, axes = plot.figure(size=(6.0, 3.0))
axis = axes[0, 0]
for i, (pitch, row) in enumerate(zip(pitches, swept.values)):
    axis.semilogy(np.sort(factors), np.maximum(row, 1e-17), marker=".", label=f"h = {pitch:g}", **plot.style(i))
axis.axvline(2 * np.pi, color="0.5", linewidth=0.8)
axis.text(2 * np.pi, 1e-8, r" $2\pi$", fontsize=10)
axis.set(xlabel="f", ylabel="residual", title=r"How far is $h\,p_z + f L_z$ from a symmetry?")
axis.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# ## Constraints, and rotating frames
#
# A constraint must allow the displacement too. On the sliding wedge neither the momentum of the particle nor that of
# the wedge is conserved, but their horizontal sum is, and with it the motion of the center of mass:

# %%
start = wedge.start_on_incline(wedge.PARAMS, along=0.5, along_rate=-1.0)
on_wedge = lj.symmetries(wedge.system, *start, wedge.PARAMS)
print(on_wedge)
slide = lj.integrate(wedge.system, *start, wedge.PARAMS, ts=np.linspace(0.0, 1.0, 61))
momenta = {name: lj.noether_charge(wedge.system, G.shift(name)) for name in ("X", "x")}
both = lj.noether_charge(wedge.system, G.shift({"X": 1.0, "x": 1.0}))
slide.plot(charges={"p_X": momenta["X"], "p_x": momenta["x"], "p_X + p_x": both})

# %% [markdown]
# The next system has two springs on rails that turn with $\omega$ (scene `cross_rails`). In the frame of the rails
# nothing depends on time, and the Jacobi integral is constant. In the laboratory the Jacobi integral is the energy,
# which is not constant because the motor does work; but a time shift combined with a rotation is a symmetry. It gives
# the same constant: $h' = E - \omega L_z$.

# %%
at_lab = rails.to_lab(rails.PARAMS, 0.0, rails.Q0, rails.V0)
turning = lj.symmetries(rails.rotating_system, rails.Q0, rails.V0, rails.PARAMS)
laboratory = lj.symmetries(rails.lab_system, *at_lab, rails.PARAMS)
print(turning, "\n")
print(laboratory, "\n")
(name,) = laboratory
in_frame = turning["Jacobi integral"](0.0, rails.Q0, rails.V0, rails.PARAMS)
in_lab = laboratory[name](0.0, *at_lab, rails.PARAMS)
print(f"the same number: {in_frame:.12f} and {in_lab:.12f}")

# %% [markdown]
# `lj.latex` derives the equations of motion in the frame of the rails, with the Coriolis and centrifugal forces, from
# the program that computes them:

# %%
equations = lj.latex(rails.rotating_system, rails.Q0, rails.V0, rails.PARAMS)
equations

# %% [markdown]
# ## Two constants that come from no spatial symmetry
#
# Noether's list is not complete: `symmetries` searches among motions of points and finds none of these. Inside the
# elliptic cylinder $\Phi$ is quadratic, and the energies of the motions along $x$ and $y$ are separately constant. The
# dumbbell's two balls alone, on a rod without mass, are Euler's problem of two centres:
# $(\mathbf r_1\times\mathbf v)\cdot(\mathbf r_2\times\mathbf v) + 2cG\,(M_2\cos\theta_2 - M_1\cos\theta_1)$ is constant
# if the rod has no mass. (Outside the ellipse, the expressions for the two energies are those of the inside.)

# %%
ellipse = params["elliptic cylinder"]
inside = lj.integrate(systems["elliptic cylinder"], *masses.INSIDE, ellipse, ts=jnp.linspace(0.0, 4.0, 41), **settings)
outside = orbits["elliptic cylinder"]
energies = {name: masses.ellipse_energies(ellipse, o.q, o.v) for name, o in (("inside", inside), ("outside", outside))}
euler = {}
q, v, duration = masses.ORBITS["dumbbell"]
for rod in (0.0, 0.25):
    balls = params["dumbbell"] | {"rod": rod}
    orbit = lj.integrate(systems["dumbbell"], q, v, balls, ts=jnp.linspace(0.0, duration, 41), **settings)
    euler[rod] = masses.euler_integral(balls, orbit.q, orbit.v)

fig, axes = plot.figure(1, 2, size=(4.6, 3.2))
left, right = axes[0]
for i, (name, (E_x, E_y)) in enumerate(energies.items()):
    for k, (label, values) in enumerate((("x", E_x), ("y", E_y))):
        at = np.linspace(0.0, 4.0, 41)
        left.plot(at, values / values[0] - 1, label=f"$E_{label}$ {name}", **plot.style(2 * i + k))
left.set(xlabel="t", ylabel="relative change", title="Elliptic cylinder", ylim=(-1.2, 5))
left.legend(fontsize=9, frameon=False, ncols=2, loc="upper center")
for i, (rod, values) in enumerate(euler.items()):
    right.plot(orbit.t, values / values[0] - 1, label=f"mass of the rod {rod:g}", **plot.style(i))
right.set(xlabel="t", ylabel="relative change", title="Dumbbell: Euler's integral")
right.legend(fontsize=9, frameon=False)
fig

# %%
for name, row in changes.items():
    words = {"h p_z + 2π L_z with h = 1.7": "screw", "Jacobi integral": "E"}
    assert {key for key, value in row.items() if value < 1e-6} == {words.get(k, k) for k in found[name].steady}, name
assert np.nanmin(table[table > 1e-6]) > 0.04
assert fields[40][0] < fields[20][0] < fields[10][0] < -5 and abs(fields[40][1] - limit) < 1e-9
screw, printed = list(claims)[:2]
assert tests[screw] and not tests[printed] and np.ptp(moved[screw]) < 1e-7 and np.ptp(moved[printed]) > 0.1
assert max(np.max(np.abs(predicted[label] - moved[label])) for label in claims) < 1e-2
at_two_pi = np.argmin(np.abs(np.sort(factors) - 2 * np.pi))
assert swept.ok.all() and np.max(swept.values[:, at_two_pi]) < 1e-12
assert np.min(np.delete(swept.values, at_two_pi, axis=1)) > 1e-4
assert set(on_wedge.steady) == {"p_X + p_x", "Jacobi integral"}
assert name == "helix" and list(laboratory) == ["Jacobi integral - omega L_z with omega = 2.5"]
assert abs(in_frame - in_lab) < 1e-12 and equations.error < 1e-12
assert max(masses.drift(values) for values in energies["inside"]) < 1e-8
assert max(masses.drift(values) for values in energies["outside"]) > 0.1
assert masses.drift(euler[0.0]) < 1e-8 and masses.drift(euler[0.25]) > 1e-3
