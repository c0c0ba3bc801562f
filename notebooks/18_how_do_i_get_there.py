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
# # How do I get there?
#
# A start and a velocity are one question; two ends are another. `lj.connect` finds the motions from one configuration
# to another, `lj.geodesic` shortest paths, `lj.steer` the controls that bring a system where it is wanted.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import lagjax as lj

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures

# %% [markdown]
# ## Through a hoop
#
# A ball is to be in the hoop, 4 m away and 1 m up, after 1.3 s. The air takes its share, so no parabola helps: which
# velocity does it need? The answer is a trajectory of `lj.integrate` like any other.


# %%
def ball(t, q, v, params):
    return 0.5 * jnp.sum(v**2) - params["g"] * q[1]


def air(t, q, v, params):
    return -params["c"] * jnp.sqrt(jnp.sum(v**2)) * v


thrown = lj.System(ball, force=air)
throw = lj.connect(thrown, np.zeros(2), np.array([4.0, 1.0]), 0.0, 1.3, {"g": 9.81, "c": 0.05})
print(throw)
throw.start_velocity

# %% [markdown]
# How much faster, if the air were thicker? The answer has derivatives, by the implicit function theorem.


# %%
def speed(c):
    found = lj.connect(thrown, jnp.zeros(2), jnp.array([4.0, 1.0]), 0.0, 1.3, {"g": 9.81, "c": c}, outputs=2)
    return jnp.sqrt(jnp.sum(found.start_velocity**2))


thicker = float(jax.jit(jax.jacfwd(speed))(0.05))
thicker

# %% [markdown]
# ## The shortest path, and when it stops being that
#
# On the outer equator of a torus a path along the equator is the shortest one, until the ends are conjugate, after
# $\pi\sqrt{r\,(R + r)}$. From there on, a path that leaves the equator is shorter, and the equator is a saddle of the
# length: `index` counts the ways to shorten it.


# %%
def torus(q, v, params):
    around, across = q
    return (params["R"] + params["r"] * jnp.cos(across)) ** 2 * v[0] ** 2 + params["r"] ** 2 * v[1] ** 2


shape = {"R": 2.0, "r": 0.7}
conjugate = np.pi * np.sqrt(shape["r"] * (shape["R"] + shape["r"]))
shortest = lj.geodesic(torus, np.zeros(2), np.array([2.5, 0.0]), shape)
along = shortest.others[-1]
print(shortest)
print(along, "conjugate after", along.conjugate_lengths, "exactly", conjugate)

# %% [markdown]
# Geodesics in all directions from one point show why: beyond the conjugate point they cross, along a curve with cusps.

# %%
directions = np.linspace(-0.8, 0.8, 33)
v0 = np.stack([np.cos(directions) / (shape["R"] + shape["r"]), np.sin(directions) / shape["r"]], axis=1)
moving = lj.System(lambda t, q, v, params: 0.5 * torus(q, v, params))
ts = np.linspace(0.0, 7.0, 71)
fan = jax.jit(jax.vmap(lambda v: lj.integrate(moving, jnp.zeros(2), v, shape, ts=ts, throw=False).q))(v0)
plt.figure(figsize=(6, 2.6))
plt.plot(np.transpose(fan[..., 0]), np.transpose(fan[..., 1]), lw=0.6, color="tab:grey")
plt.plot(*np.transpose(shortest.connection.q), lw=2)
plt.plot(*np.transpose(along.connection.q), lw=2)
plt.plot(conjugate / (shape["R"] + shape["r"]), 0.0, "ko")
plt.xlabel("around")
plt.ylabel("across")
plt.show()

# %% [markdown]
# ## The quickest slide
#
# The time of descent is a length too, $ds^2 / (2\,g\cdot\text{depth})$. With the root of the depth as a coordinate the
# metric is regular but at the start, where nothing is evaluated.


# %%
def falls(q, v, params):
    return (v[0] ** 2 / q[1] ** 2 + 4 * v[1] ** 2) / (2 * params["g"])


def guess(t):
    return jnp.stack([10 * t**3, np.sqrt(5.0) * t])


slide = lj.geodesic(falls, np.zeros(2), np.array([10.0, np.sqrt(5.0)]), {"g": 9.80665}, starts=guess)
print(f"{float(slide.length):.12f} s; the cycloid takes 1.801603122453 s")
x, root = np.transpose(slide.connection.q)
plt.figure(figsize=(4, 2.4))
plt.plot(x, 10 - root**2)
plt.xlabel("x")
plt.ylabel("y")
plt.show()

# %% [markdown]
# ## A pole that swings up
#
# Controls are chosen instead of a start: the push on a cart that brings its pole upright in two seconds with the least
# $\int F^2\,dt$. The plan is then integrated; `defect` says how far that motion ends from where it was to end.


# %%
def cart_pole(t, q, v, p):
    cart = 0.5 * (p["m1"] + p["m2"]) * v["x"] ** 2 + p["m2"] * p["l"] * v["x"] * v["angle"] * jnp.cos(q["angle"])
    return cart + 0.5 * p["m2"] * p["l"] ** 2 * v["angle"] ** 2 + p["m2"] * p["g"] * p["l"] * jnp.cos(q["angle"])


cart = lj.System(cart_pole, force=lambda t, q, v, p: {"x": p["push"], "angle": 0.0})
rest, up = {"x": 0.0, "angle": 0.0}, {"x": 1.0, "angle": np.pi}
swing = lj.steer(
    cart, {"push": 0.0}, (rest, rest), (up, rest), lambda t, q, v, u, p: u["push"] ** 2,
    {"m1": 1.0, "m2": 0.3, "l": 0.5, "g": 9.81}, t_b=2.0, bounds={"push": (-20.0, 20.0), "x": (-2.0, 2.0)},
)  # fmt: skip
print(swing)

# %%
swing.plot()

# %%
assert float(throw.missed) < 1e-12 and 0.0 < thicker
assert shortest.kind == "minimum" and along.kind == "saddle of index 1"
assert abs(float(along.conjugate_lengths[0]) - conjugate) < 1e-9
assert abs(float(slide.length) - 1.801603122453) < 1e-10
assert abs(swing.cost - 58.8077) < 1e-3 and swing.defect < 1e-6
