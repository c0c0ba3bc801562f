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
# # How long can it run?
#
# A method that adapts its steps is the best one for a hundred turns. After a hundred thousand its energy has drifted, a
# little in each step. Steps of equal length that come straight from the Lagrangian keep the energy; here is what they
# keep, what they do not, and when they are worth it.

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
# ## Five thousand turns of an ellipse
#
# Kepler's problem with the eccentricity 0.6, by the default method at its usual tolerance, and by explicit symplectic
# steps of order 4 and 8.


# %%
def attraction(t, q, v, params):
    return 0.5 * jnp.sum(v**2) + params["GM"] / jnp.sqrt(jnp.sum(q**2))


kepler, params = lj.System(attraction), {"GM": 1.0}
turn, q0, v0 = 2 * np.pi, jnp.array([0.4, 0.0]), jnp.array([0.0, 2.0])
# No whole numbers of turns: the energy's error is that of all places on the ellipse.
ts = turn * 10.0618 * jnp.arange(501)
methods = {
    "Dopri8, rtol 1e-9": {"method": lj.Dopri8(), "max_steps": 10**6},
    "Splitting(4), 400 steps a turn": {"method": lj.Splitting(4), "dt0": turn / 400},
    "Splitting(8), 400 steps a turn": {"method": lj.Splitting(8), "dt0": turn / 400},
}
runs = {
    name: lj.integrate(kepler, q0, v0, params, ts=ts, estimate_error=False, **how) for name, how in methods.items()
}
energies = {name: np.abs(run.jacobi_integral() / run.jacobi_integral()[0] - 1)[1:] for name, run in runs.items()}
plt.figure(figsize=(6, 3))
for name, change in energies.items():
    plt.loglog(np.asarray(ts)[1:] / turn, np.maximum(change, 1e-16), lw=0.8, label=name)
plt.xlabel("turns")
plt.ylabel("relative change of the energy")
plt.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
plt.show()

# %% [markdown]
# The energy of adaptive steps goes one way; that of symplectic ones stays within a bound, at order 8 near round-off.
# The print of a motion says so: its mean, by how much it varies, and how fast it drifts.

# %%
print(runs["Splitting(8), 400 steps a turn"])

# %% [markdown]
# ## A comet
#
# With an eccentricity of 0.99 equal steps would have to be as short everywhere as they are at the sun. A *pace* says
# how long they may be; the steps follow it by a rule that reads the same both ways, and the energy stays.


# %%
def free_fall_time(t, q, params):
    return jnp.sum(q**2) ** 0.75 / jnp.sqrt(params["GM"])


comet_q, comet_v = jnp.array([0.01, 0.0]), jnp.array([0.0, np.sqrt(199.0)])
years = turn * 10.0618 * jnp.arange(101)
comet = lj.integrate(
    kepler, comet_q, comet_v, params, ts=years, method=lj.Splitting(8, pace=free_fall_time), dt0=0.06,
    estimate_error=False,
)  # fmt: skip
of_comet = np.abs(comet.jacobi_integral() / comet.jacobi_integral()[0] - 1).max()
print(f"{int(comet.stats['num_steps']) / 1000:.0f} steps a turn, energy within {of_comet:.1e}")

# %% [markdown]
# ## Anything with a Lagrangian
#
# `lj.Splitting` needs $L = T(v) - V(q)$, with constraints on positions if need be. `lj.Gauss` takes any Lagrangian. A
# double pendulum of two rods, chaotic: its path is lost after a minute, its energy and its rods are not.


# %%
def two_bobs(t, q, v, params):
    return 0.5 * jnp.sum(v["a"] ** 2 + v["b"] ** 2) - params["g"] * (q["a"][1] + q["b"][1])


def rods(t, q, params):
    return jnp.stack([jnp.sum(q["a"] ** 2) - 1.0, jnp.sum((q["b"] - q["a"]) ** 2) - 1.0])


double = lj.System(two_bobs, {"rods": lj.Holonomic(rods)})
start = {"a": jnp.array([1.0, 0.0]), "b": jnp.array([1.0, 1.0])}
rest = {"a": jnp.zeros(2), "b": jnp.zeros(2)}
hour = lj.integrate(
    double, start, rest, {"g": 9.81}, ts=jnp.linspace(0.0, 3600.0, 361), method=lj.Gauss(4), dt0=0.01,
    estimate_error=False,
)  # fmt: skip
of_swing = np.abs(hour.jacobi_integral() - hour.jacobi_integral()[0])
of_rods = np.abs(np.sum((hour.q["b"] - hour.q["a"]) ** 2, axis=1) - 1.0).max()
print(f"energy within {of_swing.max():.1e} of {9.81 * 1.0:.2f}, rods within {of_rods:.1e}")

# %% [markdown]
# ## No masses at all
#
# The Lagrangian of point vortices is linear in the velocities: there is no mass matrix, and the positions alone are the
# state. Two pairs that run one behind the other pass through each other in turn, for ever.


# %%
STRENGTHS = np.array([1.0, 1.0, -1.0, -1.0])
PAIRS = [(i, j) for i in range(4) for j in range(i)]


def stream(t, q, v, params):
    turning = 0.5 * jnp.sum(STRENGTHS * (q[:, 0] * v[:, 1] - q[:, 1] * v[:, 0]))
    logs = (STRENGTHS[i] * STRENGTHS[j] * jnp.log(jnp.sum((q[i] - q[j]) ** 2)) for i, j in PAIRS)
    return turning + sum(logs) / (4 * np.pi)


vortices = lj.System(stream)
places = jnp.array([[0.0, 1.0], [0.0, 0.3], [0.0, -1.0], [0.0, -0.3]])
frogs = lj.integrate(
    vortices, places, jnp.zeros((4, 2)), None, ts=jnp.linspace(0.0, 400.0, 2001), method=lj.Gauss(3), dt0=0.02,
    estimate_error=False,
)  # fmt: skip
plt.figure(figsize=(6, 2))
for i in range(4):
    plt.plot(frogs.q[:250, i, 0], frogs.q[:250, i, 1], lw=0.9)
plt.xlabel("x")
plt.ylabel("y")
plt.show()
impulse = np.sum(STRENGTHS[:, None] * np.asarray(frogs.q), axis=1)
of_impulse = np.abs(impulse - impulse[0]).max()
of_stream = np.abs(frogs.jacobi_integral() - frogs.jacobi_integral()[0]).max()
print(f"impulse within {of_impulse:.0e}, energy within {of_stream:.0e}")

# %% [markdown]
# ## From when on is it worth it?
#
# Energy is not everything. For one error of the *place* at the end, adaptive steps of high order are hard to beat: the
# advantage grows only with a small power of the number of periods. `lj.horizons` measures it on your motion.

# %%
found = lj.horizons(
    kepler, q0, v0, params, period=turn, periods=(10, 100, 1000), error=1e-3, methods=[lj.Nystrom12(), lj.Splitting(6)]
)
print(found)

# %%
drift = energies["Dopri8, rtol 1e-9"]
assert drift[-1] > 5 * drift[49] > 0
assert energies["Splitting(4), 400 steps a turn"].max() < 1e-5
assert energies["Splitting(8), 400 steps a turn"].max() < 2e-13
assert of_comet < 1e-8
assert of_swing.max() < 1e-4 and of_rods < 1e-12
assert of_impulse < 1e-12 and of_stream < 1e-8
