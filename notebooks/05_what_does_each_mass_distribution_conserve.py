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
# # Seven mass distributions: what does each of them conserve?
#
# A particle falls through the gravitational field of a fixed mass distribution (Goldstein, Exercise 2-19). Every
# symmetry of the masses is one of the Lagrangian, and Noether's theorem gives a constant for it: a component of the
# momentum for a translation, of the angular momentum for a rotation, the energy for time.
#
# Per unit of the particle's mass, $L = \frac{1}{2}|\mathbf v|^2 - \Phi(\mathbf q)$. Seven potentials $\Phi$, of a
# plane, a half plane, a circular cylinder, infinite or finite, an elliptic cylinder, a dumbbell and a helix, are in
# `lagjax.scenes`. Units here: $G = 1$.

# %%
import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax import plot
from lagjax.scenes import mass_distributions as masses
from lagjax.scenes import potentials

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def in_the_field_of(potential):
    def lagrangian(t, q, v, params):
        return 0.5 * (v["x"] ** 2 + v["y"] ** 2 + v["z"] ** 2) - potential(q, params)

    return lj.System(lagrangian)


# The potentials are long: diffrax's own loop over the stages compiles faster than lagjax's unrolled one.
settings = {"rtol": 1e-9, "atol": 1e-9, "method": diffrax.Dopri8()}
systems = {name: in_the_field_of(potential) for name, potential in masses.POTENTIALS.items()}

# %% [markdown]
# ## Momenta along orbits
#
# In each field one orbit without any symmetry of its own. How much does each quantity change on the way, relative to
# its largest value?


# %%
def candidates(system, t, q, v, params):
    p = lj.momentum(system, t, q, v, params)
    return {
        "p_x": p["x"],
        "p_y": p["y"],
        "p_z": p["z"],
        "L_x": q["y"] * p["z"] - q["z"] * p["y"],
        "L_y": q["z"] * p["x"] - q["x"] * p["z"],
        "L_z": q["x"] * p["y"] - q["y"] * p["x"],
        "E": lj.jacobi_integral(system, t, q, v, params),
    }


def along(system, orbit, params):
    at = lambda t, q, v: candidates(system, t, q, v, params)
    return jax.jit(jax.vmap(at))(orbit.t, orbit.q, orbit.v)


changes, orbits = {}, {}
for name, system in systems.items():
    q, v, duration = masses.ORBITS[name]
    ts = jnp.linspace(0.0, duration, 41)
    orbits[name] = lj.integrate(system, q, v, masses.PARAMS[name], ts=ts, **settings)
    found = along(system, orbits[name], masses.PARAMS[name])
    changes[name] = {key: masses.drift(values) for key, values in found.items()}

# %%
columns = ("p_x", "p_y", "p_z", "L_x", "L_y", "L_z", "E")
table = np.array([[row[key] for key in columns] for row in changes.values()])
fig, axes = plot.figure(size=(6.6, 3.6))
axis = axes[0, 0]
axis.imshow(np.where(table < 1e-6, 0.0, 1.0), cmap="cividis", vmin=-0.2, vmax=1.4, aspect="auto")
for i, row in enumerate(table):
    for k, value in enumerate(row):
        kept = value < 1e-6
        words = "constant" if kept else f"{value:.2g}"
        axis.text(k, i, words, ha="center", va="center", fontsize=8, color="white" if kept else "black")
axis.set_xticks(range(len(columns)), [f"${key}$" for key in columns])
axis.set_yticks(range(len(table)), list(changes))
axis.set_title("Largest change along the orbit, relative to the largest value")
axis.grid(False)
fig

# %% [markdown]
# "Constant" is a change below $10^{-6}$, the error of the integration; everything else moves by 4 % or more. The
# table is the expected one, with two remarks and one question.
#
# - The half plane's force is infinite. The solution that this notebook follows treats it like the rest. A strip of
#   the width $W$ pulls along $y$ with $2 G\sigma\ln W$, which has no limit for $W \to \infty$; what remains without
#   this uniform pull has one, and that was integrated. It has the symmetry of the half plane.
# - $E$ belongs to the list everywhere: "only $p_x$", as the solution says, is $p_x$ and $E$.
# - The helix seems to conserve nothing but energy.

# %%
half = masses.PARAMS["half plane"]
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
# ## The helix has a screw
#
# Turn the helix by an angle $\varepsilon$ and it looks displaced along $z$, by $h\varepsilon/2\pi$ with $h$ its
# pitch; displace it back and it is where it was. Both together, for every $\varepsilon$, are a symmetry, and the
# constant that belongs to it is $\frac{h}{2\pi} p_z + L_z$, or $h\,p_z + 2\pi L_z$. The solution speaks of a
# translation by $h$ with a rotation by $2\pi$, and prints $h\,p_z + L_z$. But a rotation by $2\pi$ does nothing at
# all, and a translation by $h$ alone is a step, not a motion: it has no constant.

# %%
pitch = masses.PARAMS["helix"]["h"]
found = along(systems["helix"], orbits["helix"], masses.PARAMS["helix"])
screw = {
    "$h\\,p_z + 2\\pi L_z$": pitch * found["p_z"] + 2 * jnp.pi * found["L_z"],
    "$h\\,p_z + L_z$, as printed": pitch * found["p_z"] + found["L_z"],
    "$p_z$": found["p_z"],
    "$L_z$": found["L_z"],
}
moved = {label: float(np.ptp(values)) for label, values in screw.items()}
fig, axes = plot.figure(size=(6.0, 3.4))
axis = axes[0, 0]
for i, (label, values) in enumerate(screw.items()):
    axis.plot(orbits["helix"].t, values - values[0], label=label, **plot.style(i))
axis.set(xlabel="t", ylabel="change since t = 0", title="Around the helix (G = 1, h = 2)")
axis.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# ### Let the orbits say the factor
#
# If $h\,p_z + f L_z$ is constant, then $h\,\Delta p_z = -f\,\Delta L_z$, and each orbit tells $f$. A sweep over the
# pitch, with a left-handed helix, $h < 0$, among the others:


# %%
def factor(point):
    params = masses.PARAMS["helix"] | {"h": point["h"]}
    q, v, duration = masses.ORBITS["helix"]
    orbit = lj.integrate(systems["helix"], q, v, params, ts=jnp.linspace(0.0, duration, 9), **settings)
    L_z = orbit.q["x"] * orbit.v["y"] - orbit.q["y"] * orbit.v["x"]
    dp, dL = orbit.v["z"] - orbit.v["z"][0], L_z - L_z[0]
    return -point["h"] * jnp.sum(dp * dL) / jnp.sum(dL * dL)


pitches = np.array([-3.0, -2.0, -1.0, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0])
factors = lj.sweep(factor, {"h": pitches}, progress=False)
fig, axes = plot.figure(size=(6.0, 3.0))
axis = axes[0, 0]
axis.axhline(2 * np.pi, label=r"$2\pi$", **plot.style(0))
axis.axhline(1.0, label="1, as printed", **plot.style(1))
axis.plot(pitches, factors.values, "o", color="black", markersize=5, label="from the orbits")
axis.set(xlabel="pitch h / radius of the helix", ylabel="f", title=r"The factor in $h\,p_z + f L_z$", ylim=(0.0, 7.5))
axis.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# ## Two constants from no symmetry of space
#
# Noether's list is not complete. Inside the elliptic cylinder $\Phi$ is quadratic, and the energies of the motions
# along $x$ and $y$ are constant one by one. The dumbbell's two balls alone, on a rod without mass, are Euler's
# problem of two centres:
# $(\mathbf r_1\times\mathbf v)\cdot(\mathbf r_2\times\mathbf v) + 2cG\,(M_2\cos\theta_2 - M_1\cos\theta_1)$ is
# constant, until the rod is given a mass. (Outside the ellipse, the expressions for the two energies are those of the
# inside.)

# %%
ellipse = masses.PARAMS["elliptic cylinder"]
inside = lj.integrate(systems["elliptic cylinder"], *masses.INSIDE, ellipse, ts=jnp.linspace(0.0, 4.0, 41), **settings)
outside = orbits["elliptic cylinder"]
energies = {name: masses.ellipse_energies(ellipse, o.q, o.v) for name, o in (("inside", inside), ("outside", outside))}
euler = {}
q, v, duration = masses.ORBITS["dumbbell"]
for rod in (0.0, 0.25):
    params = masses.PARAMS["dumbbell"] | {"rod": rod}
    orbit = lj.integrate(systems["dumbbell"], q, v, params, ts=jnp.linspace(0.0, duration, 41), **settings)
    euler[rod] = masses.euler_integral(params, orbit.q, orbit.v)

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
    expected = {"p_x", "p_y", "p_z", "L_z", "E"} & set(masses.CONSERVED[name])
    assert {key for key, value in row.items() if value < 1e-6} == expected, name
assert np.min(table[table > 1e-6]) > 0.04
assert fields[40][0] < fields[20][0] < fields[10][0] < -5 and abs(fields[40][1] - limit) < 1e-9
kept, printed = moved["$h\\,p_z + 2\\pi L_z$"], moved["$h\\,p_z + L_z$, as printed"]
assert kept < 1e-7 and printed > 0.1, (kept, printed)
assert factors.ok.all() and np.max(np.abs(factors.values / (2 * np.pi) - 1)) < 1e-6
assert max(masses.drift(values) for values in energies["inside"]) < 1e-8
assert max(masses.drift(values) for values in energies["outside"]) > 0.1
assert masses.drift(euler[0.0]) < 1e-8 and masses.drift(euler[0.25]) > 1e-3
