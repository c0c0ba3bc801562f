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
# # A particle on a sliding wedge: who does work on whom?
#
# A particle of mass $m$ slides without friction down a wedge of mass $M$ and angle $\alpha$, which itself slides
# without friction on the floor (Goldstein, Exercise 2-20). $X$ is the wedge's top corner, $x$ and $y$ are the
# particle's coordinates, $y$ downwards. One constraint keeps the particle on the incline, and its multiplier is the
# normal force $\mathbf N = \lambda\,(\sin\alpha, -\cos\alpha)$ of the wedge on the particle.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import sliding_wedge as exact

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def lagrangian(t, q, v, params):
    m, M, g = params["m"], params["M"], params["g"]
    return 0.5 * m * (v["x"] ** 2 + v["y"] ** 2) + 0.5 * M * v["X"] ** 2 + m * g * q["y"]


def incline(t, q, params):
    return (q["x"] - q["X"]) * jnp.sin(params["alpha"]) - q["y"] * jnp.cos(params["alpha"])


wedge = lj.System(lagrangian, constraints={"incline": lj.Holonomic(incline)})
params = {"m": 1.5, "M": 4.0, "alpha": 0.5, "g": 9.8125}  # kg, kg, rad, m/s²
m, M, g, alpha = params["m"], params["M"], params["g"], params["alpha"]
s, c = np.sin(alpha), np.cos(alpha)
rest = {"X": 0.0, "x": 0.0, "y": 0.0}

# %% [markdown]
# ## The work of the normal force
#
# The particle is released from rest. The power of the normal force on the particle is $\mathbf N\cdot\mathbf v$, that
# on the wedge $-\mathbf N\cdot\mathbf V$: action and reaction.

# %%
ts = jnp.linspace(0.0, 0.75, 31)
traj = lj.integrate(wedge, rest, rest, params, ts=ts, rtol=1e-11, atol=1e-11)
force = traj.multipliers["incline"]
on_particle = force * (traj.v["x"] * s - traj.v["y"] * c)
on_wedge = -force * traj.v["X"] * s
gain_of_wedge = 0.5 * M * traj.v["X"] ** 2
gain_of_particle = 0.5 * m * (traj.v["x"] ** 2 + traj.v["y"] ** 2) - m * g * traj.q["y"]
traj

# %% [markdown]
# The solution that this notebook follows prints for the particle
#
# $$\frac{\mathrm{d}W_m}{\mathrm{d}t} = +\,\lambda g t\,\sin^2\alpha\cos\alpha\,\frac{m/M}{1 + (m/M)\sin^2\alpha},$$
#
# and for the wedge $\mathrm{d}W_M/\mathrm{d}t = \mathbf N\cdot\mathbf V$, which is the same with a minus. It checks
# that the sum vanishes, which it does although both signs are wrong. The energy reveals the error: the integral of
# $\mathrm{d}W_M/\mathrm{d}t$ is the kinetic energy of the wedge, which started from rest.

# %%
size = force * g * ts * s**2 * c * (m / M) / (1 + (m / M) * s**2)
printed = {"particle": size, "wedge": -size}
power = {"particle": on_particle, "wedge": on_wedge}
gain = {"particle": gain_of_particle, "wedge": gain_of_wedge}
for name in power:
    integral = 0.5 * ts[-1] * power[name][-1]  # of a power that is linear in t
    print(f"{name:8}: gains {gain[name][-1]:+.6f} J; work by the multiplier {integral:+.6f} J, "
          f"as printed {0.5 * ts[-1] * printed[name][-1]:+.6f} J")  # fmt: skip

fig, axes = plot.figure(1, 2, size=(4.6, 3.4))
for i, (axis, name) in enumerate(zip(axes[0], power)):
    axis.plot(0.5 * (ts[1:] + ts[:-1]), jnp.diff(gain[name]) / ts[1], label="rate of its energy", **plot.style(0))
    axis.plot(ts[::3], power[name][::3], "o", color="black", markersize=4, label="power of the normal force")
    axis.plot(ts, printed[name], label="as printed", **plot.style(1))
    axis.axhline(0.0, color="black", linewidth=0.8)
    axis.set(xlabel="t / s", ylabel="power / W", title=f"on the {name}", ylim=(-7, 7))
    axis.legend(fontsize=9, frameon=False, loc=("upper left", "lower left")[i])
fig

# %% [markdown]
# The wedge recedes, so the angle between the normal force and the particle's velocity is more than 90°: the
# wedge takes 2.285 J from the particle in 0.75 s. The energy ledger integrates the power of every force, by coordinate,
# and gives the same numbers. It does not use the energy itself, so an inconsistency would show in its last line.

# %%
ledger = lj.energy_ledger(traj)
ledger

# %% [markdown]
# ## Who gets the energy?
#
# When the particle has fallen by $y$, the energy $m g y$ has been released. How much of it does the wedge have? This is
# a sweep over the mass ratio and the angle, with one second of motion each.


# %%
def share(point):
    changed = params | {"alpha": point["alpha"], "M": m / point["ratio"]}
    end = lj.integrate(wedge, rest, rest, changed, ts=jnp.array([0.0, 1.0]), rtol=1e-9, atol=1e-9).end
    power = -end.multipliers["incline"] * end.v["X"] * jnp.sin(point["alpha"])
    set_free = m * g * end.q["y"]
    return {
        "of the energy": 0.5 * changed["M"] * end.v["X"] ** 2 / set_free,
        "as work": 0.5 * end.t * power / set_free,
        "force": end.multipliers["incline"] / (m * g),
    }


angles, ratios = np.radians(np.linspace(2.0, 88.0, 44)), np.geomspace(0.01, 1000.0, 51)
swept = lj.sweep(share, {"alpha": angles, "ratio": ratios}, progress=False)
sine, cosine = np.sin(angles)[:, None], np.cos(angles)[:, None]
closed = ratios * cosine**2 / ((1 + ratios) * (1 + ratios * sine**2))
print(swept)
print(f"share of the wedge: off its closed form by {np.max(np.abs(swept.values['of the energy'] - closed)):.0e}")

# %%
fig, axes = plot.figure(1, 2, size=(4.9, 3.7))
left, right = axes[0]
shown = left.pcolormesh(
    ratios, np.degrees(angles), 100 * swept.values["of the energy"], cmap="cividis", shading="nearest"
)
fig.colorbar(shown, ax=left, label="share of the wedge / %")
left.plot(1 / np.sin(angles), np.degrees(angles), color="white", linestyle="--", label=r"$M = m\,\sin\alpha$")
left.set(
    xlabel="m / M", ylabel=r"angle $\alpha$ / degrees", xscale="log", xlim=(0.01, 1000.0), title="Energy of the wedge"
)
left.legend(fontsize=9, facecolor="0.35", edgecolor="none", labelcolor="white", loc="upper right")
left.grid(False)
for i, k in enumerate((4, 14, 29)):
    best = (1 - np.sin(angles[k])) / (1 + np.sin(angles[k]))
    right.semilogx(ratios, 100 * closed[k], label=rf"$\alpha$ = {np.degrees(angles[k]):.0f}°", **plot.style(i))
    right.semilogx(
        ratios[::3], 100 * swept.values["as work"][k, ::3], plot.MARKERS[i], color=plot.COLOURS[i], markersize=4
    )
    right.axhline(100 * best, color=plot.COLOURS[i], linewidth=0.7)
right.set(xlabel="m / M", ylabel="share of the wedge / %", title="Lines: closed form. Marks: work of N")
right.set_ylim(-3, 95)
right.legend(fontsize=9, frameon=False, loc="upper left", ncols=3)
fig

# %% [markdown]
# With $u = m/M$ the share is $u\cos^2\alpha\,/\,[(1 + u)(1 + u\sin^2\alpha)]$. For a given angle it is largest at
# $M = m\sin\alpha$, the dashed line, where it is $(1 - \sin\alpha)/(1 + \sin\alpha)$, the thin lines: 70 per cent at
# 10°, 33 at 30° and 7 at 60°. A light wedge moves away fast but carries little energy; a heavy one hardly moves.
#
# ## Two formulas that fail
#
# The solution says that for $M \gg m$ the acceleration along the incline *approximates* $g\sin\alpha$. In the
# laboratory it *is* $g\sin\alpha$, for every $M$: the normal force has no component along the incline. The acceleration
# relative to the wedge is what tends to $g\sin\alpha$.
#
# It also derives $p_x = m\dot x + M\dot X = 0$ a second time from "$a_y = a_x(1 + m/M)/\tan\alpha$". That is right with
# $\cdot\tan\alpha$ and wrong with $/\tan\alpha$, except at 45°, where nobody would notice.


# %%
def pulls(point):
    return lj.accelerations(wedge, 0.0, rest, rest, params | {"M": m / point["ratio"]})[0]


a = lj.sweep(pulls, {"ratio": ratios}, progress=False).values
in_lab = a["x"] * c + a["y"] * s
relative = (a["x"] - a["X"]) * c + a["y"] * s
fig, axes = plot.figure(1, 2, size=(4.6, 3.4))
left, right = axes[0]
left.semilogx(ratios, in_lab / (g * s), label="in the laboratory", **plot.style(0))
left.semilogx(ratios, relative / (g * s), label="relative to the wedge", **plot.style(1))
left.set(xlabel="m / M", ylabel=r"acceleration along the incline / $g\sin\alpha$", title=r"$\alpha$ = 0.5 rad")
left.legend(fontsize=9, frameon=False)
right.semilogx(ratios, a["y"] / g, label="lagjax", linewidth=3.5, color=plot.COLOURS[5])
right.semilogx(ratios, a["x"] * (1 + ratios) * np.tan(alpha) / g, label=r"$a_x(1 + m/M)\,\tan\alpha$", **plot.style(0))
right.semilogx(ratios, a["x"] * (1 + ratios) / np.tan(alpha) / g, label=r"$a_x(1 + m/M)\,/\tan\alpha$", **plot.style(1))
right.set(xlabel="m / M", ylabel=r"$a_y\,/\,g$", title="The particle cannot fall faster than g")
right.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# A wedge without mass is still a constraint, although the mass matrix is then singular: the particle falls freely, and
# the wedge moves out of its way with the acceleration $g\cot\alpha$.

# %%
massless, forces = lj.accelerations(wedge, 0.0, rest, rest, params | {"M": 0.0})
print({name: round(float(value), 9) + 0.0 for name, value in massless.items()}, float(forces["incline"]) + 0.0)

# %%
constant = exact.exact_accelerations(params)
assert np.max(np.abs(force - constant.incline)) < 1e-9
assert np.max(np.abs(on_particle + on_wedge)) < 1e-9 and np.max(np.abs(printed["particle"] + printed["wedge"])) == 0
assert np.max(np.abs(on_particle + size)) < 1e-9, "the right sign"
for name in power:
    assert abs(0.5 * ts[-1] * power[name][-1] - gain[name][-1]) < 1e-9
    assert abs(0.5 * ts[-1] * printed[name][-1] - gain[name][-1]) > 4.5, "the printed one"
assert abs(gain["wedge"][-1] - 2.285) < 5e-4
booked = ledger.constraints["incline"].work
assert np.max(np.abs(booked["X"] - gain_of_wedge)) < 1e-9 and ledger.closes
assert np.max(np.abs(booked["x"] + booked["y"] - gain_of_particle)) < 1e-9
assert swept.ok.all() and np.max(np.abs(swept.values["of the energy"] - closed)) < 1e-9
assert np.max(np.abs(swept.values["as work"] - closed)) < 1e-9
assert np.max(np.abs(swept.values["force"] - cosine / (1 + ratios * sine**2))) < 1e-9
largest = (1 - np.sin(np.radians([10, 30, 60]))) / (1 + np.sin(np.radians([10, 30, 60])))
assert np.allclose(np.degrees(angles[[4, 14, 29]]), [10, 30, 60]) and np.allclose(100 * largest, [70, 33, 7], atol=0.5)
assert np.all(closed <= (1 - sine) / (1 + sine) + 1e-12)
assert np.allclose(np.max(closed[[4, 14, 29]], axis=1), largest, rtol=5e-3)
assert np.allclose(in_lab, g * s, rtol=1e-11) and abs(relative[0] / (g * s) - 1) < 0.01 and relative[-1] / (g * s) > 4
assert np.allclose(a["y"], a["x"] * (1 + ratios) * np.tan(alpha), rtol=1e-10)
assert np.min(np.abs(a["x"] * (1 + ratios) / np.tan(alpha) / a["y"] - 1)) > 2, "the printed one"
assert abs(massless["y"] - g) < 1e-12 and abs(massless["X"] + g / np.tan(alpha)) < 1e-12 and abs(massless["x"]) < 1e-12
