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
# # Which parameters of a double pendulum does its motion determine?
#
# Two arms swing freely, and a camera or an encoder records two angles. The arms have masses, lengths and moments of
# inertia, but the motion does not determine them. Angles are absolute, $\pi$ hangs down. With $B$ the second arm's
# moment of inertia about its joint, the Lagrangian has five coefficients and friction in the two joints two more:
#
# $$L = \tfrac12 A\dot\theta_1^2 + \tfrac12 B\dot\theta_2^2 + C\dot\theta_1\dot\theta_2\cos(\theta_1-\theta_2)
# - D\cos\theta_1 - E\cos\theta_2, \qquad R = \tfrac12 k_1\dot\theta_1^2 + \tfrac12 k_2(\dot\theta_2-\dot\theta_1)^2$$

# %%
import os

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 80  # small pictures


def lagrangian(t, q, v, params):
    (a, b), (u, w) = (q["theta1"], q["theta2"]), (v["theta1"], v["theta2"])
    kinetic = 0.5 * params["A"] * u**2 + 0.5 * params["B"] * w**2 + params["C"] * u * w * jnp.cos(a - b)
    return kinetic - params["D"] * jnp.cos(a) - params["E"] * jnp.cos(b)


def friction(t, q, v, params):
    return 0.5 * params["k1"] * v["theta1"] ** 2 + 0.5 * params["k2"] * (v["theta2"] - v["theta1"]) ** 2


pendulum = lj.System(lagrangian, dissipation=friction)
solve = {"rtol": 1e-6, "atol": 1e-6}

# %% [markdown]
# ## The record
#
# With `LAGJAX_DOUBLE_PENDULUM` set to the path of a file (comma-separated, with the first line
# `t[s],theta1[rad],theta2[rad],...`) this notebook fits that file. Without it, as here, it makes its own measurements:
# the motion that follows from the published parameters of the MultiArm pendulum (University of Washington; Kaheman,
# Fasel, Bramburger, Strom, Kutz and Brunton; MIT licence), 20 s at 100 Hz, with errors of 2 mrad.

# %%
arms = {  # kg, m, kg m², kg m²/s, m/s²
    "m1": 0.0938439748, "m2": 0.13759597, "a1": 0.108565215, "a2": 0.116779018, "L1": 0.172719204, "I1": 4.3752943e-4,
    "I2": 1.26882939e-3, "k1": 2.37142783e-4, "k2": 1e-5, "g": 9.80858023,
}  # fmt: skip
coefficients = {
    "A": arms["I1"] + arms["m1"] * arms["a1"] ** 2 + arms["m2"] * arms["L1"] ** 2,
    "B": arms["I2"] + arms["m2"] * arms["a2"] ** 2,
    "C": arms["m2"] * arms["a2"] * arms["L1"],
    "D": (arms["m1"] * arms["a1"] + arms["m2"] * arms["L1"]) * arms["g"],
    "E": arms["m2"] * arms["a2"] * arms["g"],
    "k1": arms["k1"],
    "k2": arms["k2"],
}
published = {name: value / coefficients["B"] for name, value in coefficients.items()}


def read(path):
    with open(path) as file:
        columns = [name.split("[")[0].strip() for name in file.readline().split(",")]
        named = dict(zip(columns, np.loadtxt(file, delimiter=",").T))
    return named["t"], {"theta1": named["theta1"], "theta2": named["theta2"]}


def make(sigma=0.002):
    t = np.arange(2001) / 100.0
    start = {"theta1": 0.6, "theta2": 1.6}, {"theta1": 0.0, "theta2": 0.0}
    motion = lj.integrate(pendulum, *start, published, ts=t, rtol=1e-10, atol=1e-10).q
    random = np.random.default_rng(1)
    return t, {name: np.asarray(x) + sigma * random.standard_normal(len(t)) for name, x in motion.items()}


path = os.environ.get("LAGJAX_DOUBLE_PENDULUM")
t, angles = read(path) if path else make()
record = lj.Record(t, q=angles, sigma=None if path else 0.002)
print(record)

fig, axes = plot.figure(size=(7.0, 2.6))
axis = axes[0, 0]
for i, (name, x) in enumerate(angles.items()):
    axis.plot(t, x, linewidth=1.0, label=rf"$\theta_{i + 1}$", **plot.style(i))
axis.set(xlabel="t / s", ylabel="angle / rad", title="What was measured")
axis.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# ## Before anything is fitted
#
# There are seven coefficients in SI units. Which of them will a record of this kind determine? `identifiability` needs
# the times and a guess, not the measured values. The first two seconds are enough for this question.

# %%
early = t < t[0] + 2.0
first = lj.Record(t[early], q={name: x[early] for name, x in angles.items()}, sigma=0.002)
asked = lj.identifiability(pendulum, first, coefficients, **solve)
print(asked)

# %% [markdown]
# The record determines six ratios of the seven numbers: multiplying $L$ and $R$ by any factor gives the same motion. So
# $B$ is fixed at 1, and the other six are fitted. To find the masses of the arms you need a balance, not a camera.
#
# ## The fit, in windows
#
# Every guess is 15 to 20 % off, those of friction by a factor of two. The record is cut into windows of 0.6 s. Each
# window has its own initial state, and all share the coefficients.

# %%
off = {"A": 1.2, "C": 0.85, "D": 1.2, "E": 0.85, "k1": 2.0, "k2": 2.0}
guess = {"B": 1.0} | {name: factor * published[name] for name, factor in off.items()}
units = {"D": "1/s²", "E": "1/s²", "k1": "1/s", "k2": "1/s"}
found = lj.fit(pendulum, record, guess, free=list(off), units=units, window=0.6, joined=False, progress=False, **solve)
print(found)

# %% [markdown]
# The residuals are as large as the measurement errors, and as white: they contain nothing of the motion any more. Here
# are the results next to the numbers that made the record:

# %%
truth = np.array([published[name] for name in found.names])
sd = np.asarray(found.sd)
deviations = (np.asarray(found.values) - truth) / sd
for name, x, s, true, d in zip(found.names, found.values, sd, truth, deviations):
    print(f"{name:<3} {x:11.5f} ± {s:.5f}   published {true:11.5f}   {d:+.1f} standard deviations")

fig, axes = plot.figure(size=(5.0, 2.6))
axis = axes[0, 0]
axis.axvspan(-1, 1, color="0.9")
axis.errorbar(deviations, found.names, xerr=1.0, fmt="o", color=plot.COLOURS[0], capsize=3)
axis.axvline(0.0, color="black", linewidth=0.8)
axis.invert_yaxis()
axis.set(xlabel="(estimate - truth) / standard deviation", title="As far off as they say that they are")
fig

# %% [markdown]
# ## Why windows
#
# Here are the same coefficients with one initial state for the whole record: the fitted motion continues from the first
# window.

# %%
alone = found.motion(ts=t)
of_one_start = np.abs(np.asarray(alone.q["theta2"]) - angles["theta2"])
of_windows = np.abs(found.residuals()["theta2"])
lost = float(t[np.argmax(of_one_start > 0.5)] - t[0])
print(f"0.5 rad off after {lost:.1f} s; in windows never more than {of_windows.max():.3f} rad")

fig, axes = plot.figure(size=(7.0, 2.8))
axis = axes[0, 0]
axis.semilogy(t, of_one_start, label="one start", linewidth=1.2, **plot.style(1))
axis.semilogy(t, of_windows, ".", markersize=2, color=plot.COLOURS[0], label="windows of 0.6 s")
axis.set(xlabel="t / s", ylabel=r"|fit - measured| of $\theta_2$ / rad", ylim=(1e-5, 1e2))
axis.set_title("A start that is known to a milliradian is forgotten")
axis.legend(fontsize=9, frameon=False, loc="center right")
fig

# %% [markdown]
# The motion is chaotic: the small error of the initial state grows until the phase is lost, and later measurements say
# nothing about that state any more. A fit with one initial state for all 20 s would have to find its minimum among
# countless others. A window must be shorter than that time; how long it may be depends on how violently the arms swing.
# Within a window the motion behaves as well as any other.

# %%
assert asked.rank == 6 and asked.combined() == ["A/B", "A/C", "A/D", "A/E", "A/k1", "A/k2"]
assert found.converged and len(found.names) == 6
assert np.all(np.abs(found.values / truth - 1)[:4] < 0.01)
if path is None:
    assert 0.95 < found.chi2 / found.freedom < 1.05 and max(map(abs, found.whiteness().values())) < 0.1
    assert np.all(np.abs(deviations) < 3) and np.mean(deviations**2) < 3
    assert of_windows.max() < 0.01 and 1.0 < lost < 15.0
