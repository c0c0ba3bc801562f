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
# # What to measure next, and how certain the result is
#
# A pendulum swings in air, and three seconds of it have been measured. How strong is the friction? The record says
# little, because it is short. Before the next run we can compute which run would determine it, and at which times to
# measure. After the run there is another question: does the ± of a fit describe everything that the data say?
#
# $$L = \tfrac12\dot\theta^2 + \omega^2\cos\theta, \qquad R = \tfrac12 c\,\dot\theta^2$$

# %%
import blackjax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy.special import ellipj

import lagjax as lj
from lagjax.display import plots as plot

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 80  # small pictures


def lagrangian(t, q, v, params):
    return 0.5 * v**2 + params["w2"] * jnp.cos(q)


def friction(t, q, v, params):
    return 0.5 * params["c"] * v**2


pendulum = lj.System(lagrangian, dissipation=friction)
truth = {"w2": 7.85, "c": 0.03}  # 1/s², 1/s
sigma = 0.01  # rad


def measured(ts, angle, seed):
    motion = lj.integrate(pendulum, angle, 0.0, truth, ts=ts)
    return motion.q + sigma * np.random.default_rng(seed).normal(size=len(ts))


short = np.linspace(0.0, 3.0, 40)
record = lj.Record(short, q=measured(short, 1.0, 0), q0=1.0, v0=0.0, sigma=sigma)
found = lj.fit(pendulum, record, {"w2": 7.0, "c": 0.1}, progress=False)
print(found)

# %% [markdown]
# ## Which run would determine it
#
# Ten more seconds can be measured, with forty samples again, from any angle. `identifiability` gets one `Record` for
# each angle: its times and its initial state, which will be as unknown as that of the first run. The measured values do
# not matter, so they are zeros. Nothing is fitted; the derivatives of the motion at the estimate say how large the ± of
# `c` will be.

# %%
long = np.linspace(0.0, 10.0, 40)
angles = np.linspace(0.1, 3.1, 31)
runs = {f"from {angle:.1f}": lj.Record(long, q=np.zeros(40), q0=float(angle), v0=0.0, sigma=sigma) for angle in angles}
asked = lj.identifiability(pendulum, record, found.params, shrink="c", candidates=runs)
print(asked)

# %%
told = asked.next
fig, axes = plot.figure(size=(7.0, 2.8))
axis = axes[0, 0]
axis.semilogy(angles, [told[name].sd for name in runs], "o-", markersize=3, color=plot.COLOURS[0])
axis.axhline(told.now, color="black", linewidth=0.8, linestyle="--")
axis.text(0.1, told.now * 1.1, "now", fontsize=9)
axis.set(xlabel="start of the next run / rad", ylabel="± of c after it / (1/s)", ylim=(8e-5, 1e-2))
axis.set_title("A run from near the top tells thirty times more than a small swing")
fig

# %% [markdown]
# In a small swing friction shows only in the decrease of the amplitude. In a large swing the period depends on the
# amplitude: friction changes the period, which can be timed over many oscillations. The dependence is strongest nearest
# to the top; how exactly the bob was released there does not matter, since the initial state is fitted too.
#
# ## When to measure
#
# Only a few times of the run from 2.0 matter. `at_best(k)` finds them by exchanging one time of a set after the other
# for a better one.

# %%
run = told["from 2.0"]
counts = [3, 4, 6, 10, 20]
few = {count: run.at_best(count) for count in counts}
motion = lj.integrate(pendulum, 2.0, 0.0, found.params, ts=np.linspace(0.0, 10.0, 400))

fig, axes = plot.figure(2, 1, size=(7.0, 2.2), sharex=True)
axes[0, 0].plot(motion.t, motion.q, linewidth=1.0, color="0.6")
times, _ = few[6]
axes[0, 0].plot(times, np.interp(times, motion.t, motion.q), "o", color=plot.COLOURS[1])
for i, count in enumerate(counts):
    axes[1, 0].plot(few[count][0], np.full(count, i), "o", markersize=4, color=plot.COLOURS[0])
axes[1, 0].set_yticks(range(len(counts)), [f"{count}: ± {few[count][1]:.1e}" for count in counts])
axes[0, 0].set(ylabel="angle / rad", title="The best six of forty times")
axes[1, 0].set(xlabel="t / s", ylabel="times, and the ± of c")
fig

# %% [markdown]
# ## The run is made
#
# With the record of the second run the ± is as predicted.

# %%
records = [record, lj.Record(long, q=measured(long, 2.0, 1), q0=2.0, v0=0.0, sigma=sigma)]
both = lj.fit(pendulum, records, found.params, progress=False)
print(f"c = {both.params['c']:.5f} ± {both.sd[0]:.5f}; foretold ± {run.sd:.5f}, before ± {found.sd[0]:.5f}")

# %% [markdown]
# ## The whole distribution
#
# A ± belongs to a normal distribution, and the Gauss-Newton approximation uses only first derivatives. `laplace` uses
# the true second derivatives and says where the two differ. Here they do not: there are 80 samples with small errors.

# %%
print(both.laplace())

# %% [markdown]
# This changes with few and noisy data. Take a pendulum without friction, released at rest from an unknown angle and
# measured four times with errors of 0.2 rad: a faster pendulum with a larger swing moves nearly the same. Everything is
# known exactly here: the motion from rest is $\theta(t) = 2\arcsin(k\,\mathrm{cd}(\omega t, k))$ with
# $k = \sin(\theta_0/2)$, and a sum over a grid of two numbers is the posterior.

# %%
free_swing = lj.System(lagrangian)
ts, rough, prior = np.array([0.5, 1.0, 3.6, 3.8]), 0.2, (4.0, 1.5)


def angle(t, w2, amplitude):
    m = np.sin(amplitude / 2) ** 2
    _, cn, dn, _ = ellipj(np.sqrt(w2) * t, m)
    return 2 * np.arcsin(np.sqrt(m) * cn / dn)


data = angle(ts, 4.0, 2.2) + rough * np.random.default_rng(0).normal(size=4)
axis_w2, axis_a = np.linspace(0.5, 11.0, 900), np.linspace(0.3, 3.1, 800)
w2, a = np.meshgrid(axis_w2, axis_a, indexing="ij")
squares = sum(((angle(t, w2, a) - y) / rough) ** 2 for t, y in zip(ts, data)) + ((w2 - prior[0]) / prior[1]) ** 2
exact = np.exp(-0.5 * (squares - squares.min()))
exact /= exact.sum()

# %% [markdown]
# Now the same with a sampler. `log_posterior` is a plain function of the unknowns; `standardised` turns it into a
# function of a vector whose entries have about unit size and are about uncorrelated, which suits NUTS. The run begins
# at its first time, when nothing is measured yet; it is known to begin at rest.

# %%
seen = lj.Record(np.append(0.0, ts), q=np.append(np.nan, data), q0=2.0, v0=0.0, hold_v=True, sigma=rough)
few_data = lj.fit(free_swing, seen, {"w2": 4.0}, priors={"w2": prior}, bounds={"w2": (0.0, None)}, progress=False)
normal = few_data.laplace()
print(normal)

kernel = blackjax.nuts(normal.standardised(few_data.log_posterior), step_size=0.5, inverse_mass_matrix=jnp.ones(2))


@jax.jit
def chain(key):
    step = lambda state, key: (kernel.step(key, state)[0],) * 2
    return jax.lax.scan(step, kernel.init(jnp.zeros(2)), jax.random.split(key, 4200))[1].position[200:]


def numbers(draws):
    # What a start is away from the guess, 2.0 rad.
    return np.asarray(draws["w2"]), 2.0 + np.asarray(draws["starts"])[:, 0, 0]


sampled = numbers(normal.unknowns(chain(jax.random.key(0))))
drawn = numbers(normal.sample(jax.random.key(1), 40000))

# %%
fig, axes = plot.figure(1, 2, size=(4.2, 3.2))
left, right = axes[0]
mass = np.sort(exact.ravel())[::-1]
levels = [mass[np.searchsorted(np.cumsum(mass), share)] for share in (0.95, 0.68)]
left.plot(sampled[0][::4], sampled[1][::4], ".", markersize=2, color=plot.COLOURS[5], label="NUTS")
left.contour(axis_w2, axis_a, exact.T, levels, colors="black", linewidths=0.9)
by_z = np.linalg.cholesky(normal.covariance)
for radius in (1.515, 2.448):  # 68 % and 95 % of a normal distribution in the plane
    around = radius * by_z @ np.stack([np.cos(np.linspace(0, 7, 200)), np.sin(np.linspace(0, 7, 200))])
    left.plot(*(normal.mean[:, None] + around), linewidth=1.0, **plot.style(1))
left.set(xlabel=r"$\omega^2$ / (1/s²)", ylabel="amplitude / rad", xlim=(2.2, 6.2), ylim=(1.4, 2.8))
left.set_title("68 and 95 %: exact, Laplace", fontsize=10)
bins = np.linspace(2.2, 6.2, 60)
right.hist(sampled[0], bins, density=True, color=plot.COLOURS[5], alpha=0.6, label="NUTS")
width = axis_w2[1] - axis_w2[0]
right.plot(axis_w2, exact.sum(axis=1) / width, color="black", linewidth=1.2, label="exact")
bell = np.exp(-0.5 * ((axis_w2 - normal.mean[0]) / normal.sd[0]) ** 2) / (np.sqrt(2 * np.pi) * normal.sd[0])
right.plot(axis_w2, bell, label="Laplace", **plot.style(1))
right.set(xlabel=r"$\omega^2$ / (1/s²)", ylabel="density", xlim=(2.2, 6.2))
right.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# The distribution is curved. The sampler follows it, and the normal distribution has the same peak and the same
# curvature at the peak. In numbers, with the Monte-Carlo error of the sampler from its effective sample size:

# %%
size = lambda x: float(blackjax.diagnostics.effective_sample_size(jnp.asarray(x)[None]))
off = {}
for name, axis_x, p, x, from_normal in zip(
    ("w2", "amplitude"), (axis_w2, axis_a), (exact.sum(axis=1), exact.sum(axis=0)), sampled, drawn
):
    mean = axis_x @ p
    sd = np.sqrt((axis_x - mean) ** 2 @ p)
    upper = np.interp(0.9, np.cumsum(p) - p / 2, axis_x)
    error = sd / np.sqrt(size(x))
    below = float(np.mean(x < upper))
    off[name] = (x.mean() - mean) / error, (below - 0.9) / (0.3 / np.sqrt(size(x < upper)))
    print(f"{name}: exact {mean:.3f} ± {sd:.3f}; 90 % are below {upper:.3f}")
    print(f"   NUTS    {x.mean():.3f} ± {x.std():.3f}; {100 * below:.1f} %; Monte-Carlo error of the mean {error:.3f}")
    share = 100 * np.mean(from_normal < upper)
    print(f"   Laplace {from_normal.mean():.3f} ± {from_normal.std():.3f}; {share:.1f} %")

# %%
assert told.best.sd < told["from 0.1"].sd / 10 and told.now > 5 * run.sd
assert few[20][1] < few[6][1] < few[3][1]
assert np.isclose(both.sd[0], run.sd, rtol=0.1) and abs(both.params["c"] - truth["c"]) < 4 * both.sd[0]
assert max(abs(x) for pair in off.values() for x in pair) < 4
assert normal.positive_definite and abs(np.mean(drawn[0] < 4.754) - 0.9) > 0.01
