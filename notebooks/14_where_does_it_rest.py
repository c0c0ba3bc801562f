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
# # Where does it rest?
#
# A bead on a hoop rests at the bottom, until the hoop turns too fast. An arch carries its load, until it snaps. A top
# sleeps upright, until friction has slowed it too much. Each "until" is a number that follows from the Lagrangian:
# `lj.equilibria` finds where a system rests, and `lj.continue_equilibria` how that changes with a parameter.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import bead_on_hoop, cross_rails

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def bead(t, q, v, params):
    a, g, omega = params["a"], params["g"], params["omega"]
    return 0.5 * a**2 * (v**2 + (omega * jnp.sin(q)) ** 2) + g * a * jnp.cos(q)


hoop = lj.System(bead)
params = {"a": 0.75, "g": 9.8125, "omega": 6.0}  # m, m/s², rad/s
rests = lj.equilibria(hoop, params, starts=np.linspace(-3.0, 3.1, 20))
rests

# %% [markdown]
# Twenty starts lead to four equilibria: the bottom, the top, and the tilt to either side, with
# $\cos\alpha = g/(a\omega^2)$.
#
# ## How fast is too fast?
#
# Followed from slow rotation upwards, the bottom loses its stability at one speed, where two branches leave it. These
# are followed too.

# %%
faster = lj.continue_equilibria(hoop, params | {"omega": 1.0}, 0.0, along="omega", to=8.0)
print(faster)
faster.plot()

# %% [markdown]
# The critical speed is not read off a grid. It is the solution of a larger system of equations that is regular there,
# so it is accurate to all digits and can be differentiated with respect to every other parameter:
# $\omega_c = \sqrt{g/a}$, $\;\partial\omega_c/\partial a = -\frac{1}{2}\sqrt{g/a^3}$.

# %%
(critical,) = faster.critical
speed = float(bead_on_hoop.natural_rate(params))
slope = -0.5 * np.sqrt(params["g"] / params["a"] ** 3)
print(f"omega_c      {float(critical.parameter):.15g}   exact {speed:.15g}")
print(f"d omega_c/da {float(critical.derivative['a']):.15g}   exact {slope:.15g}")

# %% [markdown]
# Following the tilted branch downwards, no eigenvalue changes its sign: one only touches zero, and the branch turns
# back. A fold looks the same. The determinant of the equations, extended by the branch's tangent, distinguishes them.

# %%
slower = lj.continue_equilibria(hoop, params | {"omega": 8.0}, 1.3, along="omega", to=1.0)
print(slower)

# %% [markdown]
# ## The load that an arch carries
#
# Two elastic bars lean against each other, and a load presses their joint down (von Mises' truss). The load rises to a
# fold, where the arch snaps through to hang below. With $l_0$ the length of a bar at rest, and $a$ half the span, it
# snaps at the length $l^3 = l_0 a^2$.


# %%
def truss(t, q, v, params):
    rest = jnp.sqrt(params["a"] ** 2 + params["h"] ** 2)
    return 0.5 * v**2 - params["k"] * (jnp.sqrt(params["a"] ** 2 + q**2) - rest) ** 2 - params["load"] * q


bars = {"a": 1.0, "h": 0.5, "k": 100.0, "load": -6.0}
arch = lj.continue_equilibria(lj.System(truss), bars, 0.6, along="load", to=6.0)
rest = np.hypot(bars["a"], bars["h"])
length = np.cbrt(rest * bars["a"] ** 2)
snap = 2 * bars["k"] * (rest / length - 1) * np.sqrt(length**2 - bars["a"] ** 2)
print(arch)
print(f"it snaps at {max(float(c.parameter) for c in arch.critical):.13g}, exact {snap:.13g}")
arch.plot()

# %% [markdown]
# ## Two critical speeds
#
# The carriage on rotating cross-rails has two springs. At the speed where the weaker one balances the centrifugal force
# there is a line of equilibria; where the stronger one does, the equilibrium goes to infinity. Between the two speeds
# it is unstable.

# %%
rails = cross_rails.PARAMS
cross = lj.continue_equilibria(
    cross_rails.rotating_system, rails | {"omega": 1.0}, {"R": 0.8, "r": 0.0}, along="omega", to=9.0
)
print(cross)
cross.plot()

# %% [markdown]
# ## A column under a follower force, and under a weight
#
# Two links stand on each other with springs in their joints. Under a weight they buckle: a pitchfork, with the first of
# two shapes. Under a force that follows the outer link (a rocket's thrust) they never buckle: no equilibrium changes,
# and a search for equilibria alone would not find the loss of stability. The column begins to flutter. With damping in
# the joints it does so *earlier*: at $Pl/c = 41/28$ instead of $7/2 - \sqrt 2$ if the damping is small (Ziegler, 1952).


# %%
def links(t, q, v, params):
    m, l = params["m"], params["l"]
    tip = v[0] ** 2 + v[1] ** 2 + 2 * v[0] * v[1] * jnp.cos(q[0] - q[1])
    springs = 0.5 * params["c"] * (q[0] ** 2 + (q[1] - q[0]) ** 2)
    return m * (l * v[0]) ** 2 + 0.5 * m * l**2 * tip - springs - params["weight"] * l * (jnp.cos(q[0]) + jnp.cos(q[1]))


def thrust(t, q, v, params):
    return params["thrust"] * params["l"] * jnp.stack([jnp.sin(q[0] - q[1]), 0.0 * q[1]])


def friction(t, q, v, params):
    return 0.5 * params["b"] * (v[0] ** 2 + (v[1] - v[0]) ** 2)


stick = {"m": 1.0, "l": 1.0, "c": 1.0, "b": 0.1, "weight": 0.0, "thrust": 0.0}
upright = np.zeros(2)
pressed = lj.continue_equilibria(lj.System(links), stick | {"weight": 0.1}, upright, along="weight", to=3.2)
pushed = lj.continue_equilibria(lj.System(links, force=thrust), stick, upright, along="thrust", to=3.2)
damped = lj.continue_equilibria(
    lj.System(links, force=thrust, dissipation=friction), stick, upright, along="thrust", to=3.2
)
for found in (pressed, pushed, damped):
    print(found, "\n")
pressed.plot()

# %%
fig, axes = plot.figure(1, 2, size=(4.2, 3.0), sharex=True)
for axis, found, title in zip(axes[0], (pushed, damped), ("no damping", "a little damping")):
    branch = found[0]
    for part, name in ((branch.eigenvalues.imag, "frequency"), (branch.eigenvalues.real, "growth")):
        style = plot.style(0 if name == "frequency" else 1) | {"linestyle": ""}
        axis.plot(branch.parameter, np.sort(part, axis=1)[:, 2:], ".", markersize=3, **style)
        axis.plot([], [], ".", label=name, **style)
    axis.axvline(float(found.critical[0].parameter), color="black", linewidth=0.8)
    axis.set(xlabel="thrust", title=title)
axes[0, 0].set_ylabel("roots, per unit of time")
axes[0, 0].legend(fontsize=8, frameon=False, loc="center left")
fig

# %% [markdown]
# ## A sleeping top
#
# An upright spinning top is a steady motion, in coordinates that are regular there: two tilts and the spin, which is
# cyclic. The spin rate is the parameter. At $\omega_c = 2\sqrt{M g l\,I_1}/I_3$ two frequencies meet, and the top
# becomes unstable.


# %%
def top(t, q, v, params):
    a, b = q["a"], q["b"]
    across = 0.5 * params["I1"] * ((v["a"] * jnp.cos(b)) ** 2 + v["b"] ** 2)
    about = 0.5 * params["I3"] * (v["spin"] + v["a"] * jnp.sin(b)) ** 2
    return across + about - params["Mgl"] * jnp.cos(a) * jnp.cos(b)


body = {"I1": 2.0, "I3": 0.7, "Mgl": 3.0}
asleep = {"a": 0.0, "b": 0.0, "spin": 0.0}
spun = lj.continue_equilibria(lj.System(top), body, asleep, velocity=asleep | {"spin": 12.0}, along="v.spin", to=2.0)
wakes = 2 * np.sqrt(body["Mgl"] * body["I1"]) / body["I3"]
print(spun)
print(f"it wakes at {float(spun.critical[0].parameter):.14g}, exact {wakes:.14g}")

# %% [markdown]
# ## A map
#
# Inside a program equilibria are differentiable functions of their parameters, and can be swept: where does the bead
# rest on 10,000 hoops? The white line is $\omega^2 = g/a$.

# %%
speeds, radii = np.linspace(1.0, 8.0, 100), np.linspace(0.2, 2.0, 100)


def tilt(point):
    turning = params | {"omega": point["omega"], "a": point["a"]}
    found = lj.equilibria(hoop, turning, starts=jnp.array([1.2, 0.0]))
    # The tilt where there is one; else what is stable of both.
    return jnp.max(jnp.where(found.stable, jnp.abs(found.q), 0.0))


hoops = lj.sweep(tilt, {"a": radii, "omega": speeds}, progress=False)
fig = plot.maps({"a": radii, "omega": speeds}, {"angle of rest / rad": hoops.values})
fig.axes[0].plot(speeds, params["g"] / speeds**2, color="white", linewidth=1.2)
fig.axes[0].set_ylim(radii[0], radii[-1])
fig

# %%
exact = np.arccos(np.minimum(1.0, params["g"] / (radii[:, None] * speeds**2)))
assert len(rests) == 4 and rests.stable.sum() == 2
assert abs(float(critical.parameter) / speed - 1) < 1e-10 and abs(float(critical.derivative["a"]) / slope - 1) < 1e-8
assert slower.critical[0].kind == "pitchfork" and abs(float(slower.critical[0].parameter) / speed - 1) < 1e-10
assert abs(max(float(c.parameter) for c in arch.critical) / snap - 1) < 1e-10
low, high = (float(x) for x in cross_rails.critical_speeds(rails))
assert np.allclose([c.parameter for c in cross.critical], [low, high], rtol=1e-10)
assert np.allclose([c.parameter for c in pressed.critical], [(3 - 5**0.5) / 2, (3 + 5**0.5) / 2], rtol=1e-10)
assert abs(float(pushed.critical[0].parameter) / (3.5 - 2**0.5) - 1) < 1e-10
assert abs(float(damped.critical[0].parameter) / (41 / 28 + 0.5 * stick["b"] ** 2) - 1) < 1e-10
assert abs(float(spun.critical[0].parameter) / wakes - 1) < 1e-10
assert hoops.ok.all() and np.max(np.abs(hoops.values - exact)) < 1e-6
