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
# # Turn the knobs: how fast must one shake a pendulum for it to stand on its head?
#
# The pivot of a pendulum is shaken up and down, $y = A\cos\omega t$. $\theta$ is its tilt from the *upper* vertical,
# from which it usually falls. Lengths are in units of the rod's length, times in $\sqrt{l/g}$.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 80  # small pictures


def lagrangian(t, q, v, params):
    omega, A = params["omega"], params["A"]
    across, up = v * jnp.cos(q), -v * jnp.sin(q) - A * omega * jnp.sin(omega * t)
    return 0.5 * (across**2 + up**2) - jnp.cos(q) - A * jnp.cos(omega * t)


shaken, ts = lj.System(lagrangian), jnp.linspace(0.0, 12.0, 241)


def run(point):
    params = {"omega": point["omega"], "A": point["A"]}
    motion = lj.integrate(shaken, point["tilt"], 0.0, params, ts=ts)
    return {"t": ts, "tilt": motion.q, "farthest": jnp.max(jnp.abs(motion.q))}


# %% [markdown]
# ## Sliders
#
# `run` is an ordinary function of one point, as for `lj.sweep`. `lj.interact` compiles it once and redraws the result
# whenever a slider moves: in a running notebook, drag $\omega$ to 8. (This needs `pip install "lagjax[interact]"`. In
# the hosted copy of this notebook the sliders are a picture.)

# %%
knobs = lj.interact(
    run,
    {"omega": (0.0, 15.0, 0.1), "A": (0.0, 0.3, 0.01), "tilt": (0.01, 1.0, 0.01)},
    start={"omega": 6.0, "A": 0.2, "tilt": 0.3},
    progress=False,
)
knobs

# %% [markdown]
# The pendulum falls over and goes around. With faster shaking it stands and sways about the top. A program can turn the
# knobs too:

# %%
fallen, standing = (float(knobs.set(omega=omega).result["farthest"]) for omega in (6.0, 10.0))
print(f"farthest from the top: {fallen:.2f} rad at omega = 6, {standing:.2f} rad at omega = 10")

# %% [markdown]
# ## A page that needs no Python
#
# `swept.to_html("shaken.html")` writes the swept motions into one file, with the same sliders, that works in any
# browser, without Python and without a network. It is also shown below, with an animation: play it, and change $\omega$
# meanwhile.


# %%
def motion(point):
    return lj.integrate(shaken, point["tilt"], 0.0, {"omega": point["omega"], "A": 0.2}, ts=ts)


def positions(t, q, params):
    pivot = params["A"] * np.cos(params["omega"] * t)
    return {"rod": [(0.0, pivot), (np.sin(q), pivot + np.cos(q))]}


swept = lj.sweep(motion, {"omega": np.arange(3.0, 13.0), "tilt": np.array([0.1, 0.3])}, progress=False)
page = swept.to_html(positions=positions, seconds=6.0, rate=15.0)
page

# %% [markdown]
# ## Where is the border?
#
# Averaged over the shaking, the pendulum sees the potential $\cos\theta + \frac{1}{4} A^2\omega^2\sin^2\theta$
# (Landau and Lifshitz, §30): the top is a valley for $A^2\omega^2 > 2$, and holds a tilt $\theta_0$ for
# $A^2\omega^2 \cos\theta_0 > 2$. That assumes small shaking; the sweep does not, and waits until the pendulum has
# fallen below the horizontal or has stood for 60 units of time.

# %%
axes = {"A": np.array([0.05, 0.1, 0.2, 0.3]), "A omega": np.linspace(1.38, 1.5, 121)}


def fall(point):
    params = {"omega": point["A omega"] / point["A"], "A": point["A"]}
    level = {"level": lj.Crossing(lambda t, q, v, params: jnp.cos(q))}
    return lj.integrate(shaken, 0.3, 0.0, params, ts=jnp.array([0.0, 60.0]), events=level).end.t


border = lj.sweep(fall, axes, progress=False)
stands = border.values == 60.0
first = axes["A omega"][np.argmax(stands, axis=1)]
averaged = np.sqrt(2 / np.cos(0.3))
for A, product in zip(axes["A"], first):
    print(f"A = {A:4.2f}: it stands from A omega = {product:.3f} on; averaged {averaged:.3f}")

fig, panels = plot.figure(size=(5.4, 3.0))
for i, A in enumerate(axes["A"]):
    fell = np.where(stands[i], np.nan, border.values[i])
    panels[0, 0].plot(axes["A omega"], fell, label=f"A = {A:g}", **plot.style(i))
panels[0, 0].axvline(averaged, color="black", linewidth=0.8)
panels[0, 0].set(xlabel=r"$A\omega$", ylabel="falls after", title="Line: the averaged potential's border")
panels[0, 0].legend(fontsize=8, frameon=False)
fig

# %% [markdown]
# The nearer to the border, the longer the pendulum takes to fall; up to $A = 0.1$ the border agrees with the averaged
# one within a fifth of a percent, at $A = 0.3$ it is one percent beyond it.

# %%
assert fallen > np.pi / 2 and standing < 0.35
assert set(page.title.split()) >= {"omega,", "tilt"} and len(page.html) < 150_000
assert all(np.all(np.diff(row.astype(int)) >= 0) for row in stands), "above the border it stands"
assert np.all(np.abs(first / averaged - 1) < [0.002, 0.002, 0.004, 0.011])
assert 1.008 < first[-1] / averaged
