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
# # How does it swing?
#
# Near an equilibrium, or near a steady motion, every mechanical system obeys linear equations,
#
# $$M\ddot\xi + (G + D)\dot\xi + (K + N)\xi = 0,$$
#
# and the roots say whether it oscillates, decays or diverges. `lj.linearise` computes the matrices from $L$, and
# `lj.normal_modes` the modes.

# %%
import time

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.colors import ListedColormap

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import cross_rails as exact

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def rails_lagrangian(t, q, v, params):
    m, omega = params["m"], params["omega"]
    along, across = v["R"] - omega * q["r"], v["r"] + omega * q["R"]
    springs = 0.5 * params["K"] * (q["R"] - params["R0"]) ** 2 + 0.5 * params["k"] * q["r"] ** 2
    return 0.5 * m * (along**2 + across**2) - springs


rails = lj.System(rails_lagrangian)
params = {"m": 0.5, "K": 20.0, "k": 8.0, "R0": 0.75, "omega": 2.5}  # kg, N/m, N/m, m, rad/s


def modes_of(params):
    middle = params["K"] * params["R0"] / (params["K"] - params["m"] * params["omega"] ** 2)
    return lj.normal_modes(rails, 0.0, {"R": middle, "r": 0.0}, {"R": 0.0, "r": 0.0}, params)


modes_of(params)

# %% [markdown]
# The first system is a carriage on rotating rails, with two springs and a Coriolis force that couples them. "The
# springs are softened by the rotation", says the solution that these notebooks follow. Without rotation the carriage
# oscillates with 4 and 6.325 rad/s. With rotation one of its modes is slower and the other one is faster.
#
# Both coordinates move in each mode, a quarter of a period apart: the carriage moves on ellipses.

# %%
slow, fast = modes_of(params)
fast.plot()

# %%
fast.animate(lambda t, q, params: (q["R"], q["r"]), amplitude=0.1, trail=2.0)

# %% [markdown]
# ## Two critical speeds
#
# `vmap` computes all speeds at once. Growth rates are drawn upward, and frequencies are orange where the energy of a
# mode is negative.

# %%
speeds = np.linspace(0.0, 10.0, 801)
at = jax.jit(jax.vmap(lambda omega: modes_of(params | {"omega": omega})))(speeds)
frequency, growth, energy = (np.asarray(x) for x in (at.frequency, at.growth, at.energy))
fig, axes = plot.figure(1, 2, size=(4.6, 3.2))
left, right = axes[0]
for sign, colour, label in ((1, 0, "energy > 0"), (-1, 1, "energy < 0")):
    shown = [np.where(energy[:, i] == sign, frequency[:, i], np.nan) for i in range(2)]
    left.plot(speeds, shown[0], color=plot.COLOURS[colour], label=label)
    left.plot(speeds, shown[1], color=plot.COLOURS[colour])
right.plot(speeds, growth.max(axis=1), color=plot.COLOURS[3])
lower, upper = np.sqrt(params["k"] / params["m"]), np.sqrt(params["K"] / params["m"])
for axis in axes[0]:
    axis.axvspan(lower, upper, color="0.9", zorder=0)
left.set(xlabel=r"$\omega$ / (rad/s)", ylabel="frequency / (rad/s)", title="Between the critical speeds one is lost")
right.set(xlabel=r"$\omega$ / (rad/s)", ylabel="growth / (1/s)", title="There the carriage leaves")
left.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# Above both speeds no mode grows, although both springs together push outward: the Coriolis force alone holds the
# carriage. The energy of the slow mode is negative there. So anything that removes energy makes it grow, and `verdict`
# says "gyroscopically stabilised" instead of "stable". To check this, here is the same with a little friction on the
# rails:

# %%
rubbed = lj.System(rails_lagrangian, dissipation=lambda t, q, v, p: 0.5 * p["c"] * (v["R"] ** 2 + v["r"] ** 2))
above = params | {"omega": 8.0, "c": 0.05}
middle = params["K"] * params["R0"] / (params["K"] - params["m"] * above["omega"] ** 2)
with_friction = lj.normal_modes(rubbed, 0.0, {"R": middle, "r": 0.0}, {"R": 0.0, "r": 0.0}, above)
print(modes_of(params | {"omega": 8.0}), with_friction, sep="\n\n")

# %% [markdown]
# ## A map of a hundred thousand pairs of springs
#
# The rails are stable exactly where $(1 - \omega^2 m/K)(1 - \omega^2 m/k) > 0$.

# %%
side = np.geomspace(0.05, 20.0, 320)
squared = params["m"] * params["omega"] ** 2


def verdict(point):
    springs = {"K": squared / point["mω²/K"], "k": squared / point["mω²/k"]}
    return modes_of(params | springs).code


axes_of_map = {"mω²/K": side, "mω²/k": side}
lj.sweep(verdict, axes_of_map, progress=False)  # compiles
began = time.perf_counter()
swept = lj.sweep(verdict, axes_of_map, progress=False)
took = time.perf_counter() - began
code = np.asarray(swept.values)
print(f"{code.size} points, {'less' if took < 10 else 'more'} than 10 s; "
      + ", ".join(f"{np.sum(code == i)} {at.VERDICTS[i]}" for i in np.unique(code)))  # fmt: skip
fig, axes = plot.figure(size=(5.2, 4.2))
axis = axes[0, 0]
colours = ListedColormap([plot.COLOURS[i] for i in (2, 5, 1)])
drawn = axis.pcolormesh(
    side, side, np.searchsorted([0, 2, 3], code).T, cmap=colours, vmin=-0.5, vmax=2.5, rasterized=True
)
bar = fig.colorbar(drawn, ticks=[0, 1, 2])
bar.ax.set_yticklabels(["stable", "gyroscopically\nstabilised", "divergence"])
axis.set(
    xscale="log", yscale="log", xlabel=r"$m\omega^2/K$", ylabel=r"$m\omega^2/k$", title="Below both, or above both"
)
fig

# %% [markdown]
# ## On a surface: the constraint force has a stiffness
#
# Take a pendulum in $x$ and $y$ on a rod. Its $L$ has no stiffness: $\frac{1}{2}(\dot x^2 + \dot y^2) - gy$. The rod's
# force has one, because its direction turns: with its multiplier $\lambda = -g/2l$, $K = -\lambda\,\partial^2 g$.

# %%
rod = lj.Holonomic(lambda t, q, p: q["x"] ** 2 + q["y"] ** 2 - p["l"] ** 2)
pendulum = lj.System(lambda t, q, v, p: 0.5 * (v["x"] ** 2 + v["y"] ** 2) - p["g"] * q["y"], {"rod": rod})
hanging = 0.0, {"x": 0.0, "y": -1.25}, {"x": 0.0, "y": 0.0}, {"l": 1.25, "g": 9.81}
small = lj.linearise(pendulum, *hanging)
swing = lj.normal_modes(small)
print(f"λ = {small.multipliers['rod']:.4f}, K = {small.stiffness[0, 0]:.4f}, "
      f"frequency² = {swing.frequency[0] ** 2:.6f}, g/l = {9.81 / 1.25:.6f}")  # fmt: skip

# %% [markdown]
# ## A rolling coin
#
# A coin on its edge falls over unless it rolls. It touches the ground at $(x, y)$, heads in the direction yaw, leans,
# and has turned by spin. Rolling constrains its velocities, $\dot x = r\dot\psi\cos\varphi$ and
# $\dot y = r\dot\psi\sin\varphi$, and not its positions. Its lean angle obeys, with $A$, $C$ the moments about a
# diameter and about the axle,
#
# $$\lambda^2\,(A + mr^2) = mgr - \frac{C\,(C + mr^2)}{A}\,\Omega^2,$$
#
# so that a thin coin stays upright from $\Omega^2 = g/3r$ on.


# %%
def coin_lagrangian(t, q, v, p):
    m, r, A, C = p["m"], p["r"], p["A"], p["C"]
    sin, cos, s, c = jnp.sin(q["lean"]), jnp.cos(q["lean"]), jnp.sin(q["yaw"]), jnp.cos(q["yaw"])
    x = v["x"] + r * (v["lean"] * cos * s + sin * c * v["yaw"])
    y = v["y"] - r * (v["lean"] * cos * c - sin * s * v["yaw"])
    z = -r * sin * v["lean"]
    turning = A * (v["lean"] ** 2 + (v["yaw"] * cos) ** 2) + C * (v["spin"] + v["yaw"] * sin) ** 2
    return 0.5 * m * (x**2 + y**2 + z**2) + 0.5 * turning - m * p["g"] * r * cos


def rolling(t, q, v, p):
    return jnp.stack([v["x"] - p["r"] * v["spin"] * jnp.cos(q["yaw"]), v["y"] - p["r"] * v["spin"] * jnp.sin(q["yaw"])])


coin = lj.System(coin_lagrangian, {"rolling": lj.Nonholonomic(rolling)})
m, r, g = 0.0075, 0.0116, 9.81  # a euro: kg, m, m/s²
euro = {"m": m, "r": r, "g": g, "A": m * r**2 / 4, "C": m * r**2 / 2}
upright = dict.fromkeys(("x", "y", "yaw", "lean", "spin"), 0.0)
rolls = lambda spin: lj.normal_modes(coin, 0.0, upright, upright | {"x": r * spin, "spin": spin}, euro)
critical = np.sqrt(g / (3 * r))
print(f"critical: {critical:.3f} rad/s, {critical * r:.3f} m/s")
rolls(1.5 * critical)

# %% [markdown]
# Zero roots are named and are not instabilities: the coin may roll faster, in another direction, or from another place.

# %%
ratio = np.linspace(0.0, 2.0, 201)
found = [rolls(x * critical) for x in ratio]
growths = np.array([modes.growth.max() for modes in found])
swings = np.array([modes.frequency.max() for modes in found])
inertia = euro["A"] + m * r**2
lean_squared = (m * g * r - euro["C"] * (euro["C"] + m * r**2) / euro["A"] * (ratio * critical) ** 2) / inertia
fig, axes = plot.figure(size=(5.6, 3.2))
axis = axes[0, 0]
axis.plot(ratio, growths, label="growth", **plot.style(1))
axis.plot(ratio, swings, label="frequency", **plot.style(0))
axis.plot(ratio[::8], np.sqrt(np.abs(lean_squared))[::8], "o", color="black", markersize=3.5, label="by hand")
axis.set(xlabel="spin / critical", ylabel="1/s and rad/s", title="It falls, or it weaves")
axis.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# ## Derivatives
#
# Frequencies are differentiable, for fitting and for design. By how much must $k$ change to raise the slow frequency
# of the rails by 1 %?

# %%
slow_frequency = lambda k: modes_of(params | {"k": k}).frequency[0]
value, slope = jax.value_and_grad(slow_frequency)(params["k"])
step = 0.01 * value / slope
print(f"by {step:.4f} N/m; then it is {float(slow_frequency(params['k'] + step) / value):.6f} of what it was")

# %%
squares = exact.mode_squares(params | {"omega": speeds})
away = (np.abs(speeds - lower) > 0.02) & (np.abs(speeds - upper) > 0.02)
lost = np.where(squares.slow > 0, frequency[:, 0] ** 2, -(growth.max(axis=1) ** 2))
assert np.max(np.abs(frequency[:, 1] / np.sqrt(squares.fast) - 1)) < 1e-10
assert np.max(np.abs(lost / squares.slow - 1)[away]) < 1e-10
first, second = np.meshgrid(side, side, indexing="ij")
assert np.all((code < 3) == ((1 - first) * (1 - second) > 0))
assert with_friction.growth[0] > 0 > with_friction.growth[1]
assert abs(swing.frequency[0] ** 2 / (9.81 / 1.25) - 1) < 1e-12
by_lean = np.where(lean_squared > 0, growths, swings)
far = np.abs(ratio - 1) > 0.01
assert np.max(np.abs(by_lean[far] ** 2 / np.abs(lean_squared[far]) - 1)) < 1e-9
assert abs(slow_frequency(params["k"] + step) / value - 1.01) < 1e-4
