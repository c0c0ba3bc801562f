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
# # Cross-rails: two frames, three energies. Which check sees a wrong Coriolis force?
#
# A carriage of mass $m$ rides on rails that turn with $\omega$. Along the first rail a spring $K$ of rest length
# $R_0$ pulls on its coordinate $R$, along the second a spring $k$ without rest length on $r$:
#
# $$x = R\cos\omega t - r\sin\omega t, \qquad y = R\sin\omega t + r\cos\omega t.$$
#
# In the laboratory the Lagrangian depends on time, in the turning frame it does not.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import cross_rails as exact

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def lab_lagrangian(t, q, v, params):
    c, s = jnp.cos(params["omega"] * t), jnp.sin(params["omega"] * t)
    along, across = q["x"] * c + q["y"] * s, -q["x"] * s + q["y"] * c
    springs = 0.5 * params["K"] * (along - params["R0"]) ** 2 + 0.5 * params["k"] * across**2
    return 0.5 * params["m"] * (v["x"] ** 2 + v["y"] ** 2) - springs


def turning_lagrangian(t, q, v, params):
    omega = params["omega"]
    along, across = v["R"] - omega * q["r"], v["r"] + omega * q["R"]
    springs = 0.5 * params["K"] * (q["R"] - params["R0"]) ** 2 + 0.5 * params["k"] * q["r"] ** 2
    return 0.5 * params["m"] * (along**2 + across**2) - springs


lab, turning = lj.System(lab_lagrangian), lj.System(turning_lagrangian)
params = {"m": 0.5, "K": 20.0, "k": 8.0, "R0": 0.75, "omega": 2.5}  # kg, N/m, N/m, m, rad/s
start = {"R": 1.0, "r": 0.125}, {"R": 0.25, "r": -0.5}  # m, m/s

# %% [markdown]
# ## One motion, two frames
#
# The motion is integrated once in each frame, and the results are compared.

# %%
ts = jnp.linspace(0.0, 2 * 2 * jnp.pi / params["omega"], 201)
settings = {"ts": ts, "rtol": 1e-12, "atol": 1e-12}
in_lab = lj.integrate(lab, *exact.to_lab(params, 0.0, *start), params, **settings)
in_turning = lj.integrate(turning, *start, params, **settings)
x, v = exact.to_lab(params, ts, in_turning.q, in_turning.v)
apart = max(float(jnp.max(jnp.abs(x[name] - in_lab.q[name]))) for name in x)
print(f"the two frames differ by {apart:.0e} m")

fig, axes = plot.figure(1, 2, size=(4.3, 3.8))
left, right = axes[0]
left.plot(in_lab.q["x"], in_lab.q["y"], label="x, y integrated", **plot.style(0))
left.plot(x["x"][::8], x["y"][::8], "o", color="black", markersize=4, label="from R, r")
left.set(xlabel="x / m", ylabel="y / m", aspect="equal", title="In the laboratory", xlim=(-1.5, 1.5), ylim=(-1.3, 1.7))
left.legend(fontsize=9, frameon=False, loc="upper center", ncols=2)
right.plot(in_turning.q["R"], in_turning.q["r"], **plot.style(0))
right.plot(float(exact.equilibrium_length(params)), 0.0, "+", color="black", markersize=11, label="equilibrium")
right.plot(params["R0"], 0.0, "x", color=plot.COLOURS[1], markersize=8, label=r"rest length $R_0$")
right.set(xlabel="R / m", ylabel="r / m", title="On the rails", aspect="equal", xlim=(0.5, 1.25), ylim=(-0.4, 0.45))
right.legend(fontsize=9, frameon=False, loc="upper center", ncols=2)
fig

# %% [markdown]
# The equilibrium position "is not $R_0$, but a smaller length", says the solution that this notebook follows. The
# opposite is true: the carriage circles about $R_0\,/\,(1 - m\omega^2/K) = 0.889$ m, and $R_0 = 0.75$ m.
#
# ## Three energies
#
# The Jacobi integral of the Lagrangian in the laboratory is the energy $E = T + V$; that of the rotating frame is $h'$.
# The solution prints $h' = E - m\omega(R\dot r - \dot R r) - \frac{1}{2}m\omega^2(r^2 + R^2)$, which is a third
# quantity.

# %%
E = in_lab.jacobi_integral()
h = in_turning.jacobi_integral()
q, v = in_turning.q, in_turning.v
swirl = params["m"] * params["omega"] * (q["R"] * v["r"] - v["R"] * q["r"])
spread = params["m"] * params["omega"] ** 2 * (q["r"] ** 2 + q["R"] ** 2)
printed = E - swirl - 0.5 * spread
L_z = params["m"] * (in_lab.q["x"] * in_lab.v["y"] - in_lab.q["y"] * in_lab.v["x"])
fig, axes = plot.figure(size=(6.2, 3.4))
axis = axes[0, 0]
for i, (name, values) in enumerate({"$E$": E, "$h'$": h, "$h'$ as printed": printed}.items()):
    axis.plot(ts, values, label=name, **plot.style(i))
axis.plot(ts[::8], (E - params["omega"] * L_z)[::8], "o", color="black", markersize=4, label=r"$E - \omega L_z$")
axis.set(xlabel="t / s", ylabel="energy / J", title="One of them is constant")
axis.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# The factor of the last term is 1 and not ½. Then $h' = E - \omega L_z$: the torque of the rails adds the same amount
# to $\omega L_z$ and to the energy.
#
# ## A check that cannot detect the error
#
# The solution's equations of motion have $-m\omega\dot R$ and $+m\omega\dot r$ for the Coriolis force, half of the
# correct value. They are the Lagrange equations of a Lagrangian with half of the mixed term. Does the conservation of
# $h'$ reveal the error?


# %%
def printed_lagrangian(t, q, v, params):
    half = 0.5 * params["m"] * params["omega"] * (q["R"] * v["r"] - q["r"] * v["R"])
    return turning_lagrangian(t, q, v, params) - half


as_printed = lj.System(printed_lagrangian)
wrong = lj.integrate(as_printed, *start, params, **settings)
kept = {name: float(np.ptp(exact.balance(params, w.q, w.v).h)) for name, w in (("2", in_turning), ("1", wrong))}
moved = exact.to_lab(params, ts, wrong.q, wrong.v)[0]
distance = {
    "factor 2": jnp.hypot(x["x"] - in_lab.q["x"], x["y"] - in_lab.q["y"]),
    "factor 1, as printed": jnp.hypot(moved["x"] - in_lab.q["x"], moved["y"] - in_lab.q["y"]),
}
fig, axes = plot.figure(1, 2, size=(4.6, 3.4))
left, right = axes[0]
for i, (name, w) in enumerate(zip(distance, (in_turning, wrong))):
    change = np.abs(exact.balance(params, w.q, w.v).h - h[0])
    left.semilogy(ts[1:], np.maximum(change[1:], 1e-17), label=name, **plot.style(i))
    right.semilogy(ts[1:], distance[name][1:], label=name, **plot.style(i))
left.set(xlabel="t / s", ylabel="change of h' / J", title="h' is blind", ylim=(1e-17, 30.0))
right.set(xlabel="t / s", ylabel="distance / m", title="Against the laboratory's x, y", ylim=(1e-17, 30.0))
for axis in axes[0]:
    axis.legend(fontsize=9, frameon=False, loc="center right")
fig

# %% [markdown]
# It does not: the Coriolis force does no work, whatever its factor. Compared with the laboratory frame, where there is
# no such force, the printed equations are wrong by 17 cm within a second.
#
# ## Fast rails
#
# The centrifugal force overcomes a spring at $\omega^2 = k/m$ and $\omega^2 = K/m$. Is the carriage lost above these
# speeds? The solution has it "pushed against the rotation axis". A sweep over both springs, at $\omega = 2.5$ rad/s,
# shows how far away it is after 40 s, with each of the two Coriolis forces:

# %%
squared = params["m"] * params["omega"] ** 2
sides = np.geomspace(0.08, 12.5, 24)


def how_far(system):
    def run(point):
        springs = params | {"K": squared / point["p"], "k": squared / point["q"]}
        end = lj.integrate(system, *start, springs, ts=jnp.array([0.0, 40.0]), rtol=1e-6, atol=1e-6).end
        return jnp.hypot(end.q["R"], end.q["r"])

    return lj.sweep(run, {"p": sides, "q": sides}, progress=False)


maps = {"factor 2": how_far(turning), "factor 1, as printed": how_far(as_printed)}
p, q = np.meshgrid(sides, sides, indexing="ij")
stable = (1 - p) * (1 - q) > 0
against = {name: int(np.sum((swept.values < 1000.0) != stable)) for name, swept in maps.items()}
print(maps["factor 2"])
print("verdicts against (1 - p)(1 - q) > 0, of 576:", against)

fig, axes = plot.figure(1, 2, size=(4.4, 3.9), sharey=True)
for axis, (name, swept) in zip(axes[0], maps.items()):
    far = ~(swept.values < 1000.0)
    axis.loglog(p[~far], q[~far], "o", color=plot.COLOURS[0], markersize=3, label="stays")
    axis.loglog(p[far], q[far], "x", color=plot.COLOURS[1], markersize=4, label="leaves")
    axis.axvline(1.0, color="black", linewidth=1)
    axis.axhline(1.0, color="black", linewidth=1)
    axis.set(xlabel=r"$m\omega^2/K$", title=f"Coriolis' force with {name}")
axes[0, 0].set_ylabel(r"$m\omega^2/k$")
axes[0, 1].legend(fontsize=9, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
fig

# %% [markdown]
# Between the critical speeds the carriage moves away outwards. Above *both* it is held again, by the Coriolis force
# alone, about $R = -R_0/(m\omega^2/K - 1)$, on the other side of the axis. The printed equations lose it in most of
# this quadrant. The two frequencies are the roots of
# $\Omega^4 - (\kappa + \mathrm K + 2\omega^2)\,\Omega^2 + (\kappa - \omega^2)(\mathrm K - \omega^2) = 0$ with
# $\kappa = k/m$, $\mathrm K = K/m$; and the motion is stable where $(1 - m\omega^2/K)(1 - m\omega^2/k) > 0$.
#
# "The springs are softened by the rotation" is half of the truth: the slow mode softens, the fast one stiffens.

# %%
speeds = np.linspace(0.0, 12.0, 481)
modes = exact.mode_squares(params | {"omega": speeds})
low, high = (float(speed) for speed in exact.critical_speeds(params))
fig, axes = plot.figure(size=(6.2, 3.4))
axis = axes[0, 0]
axis.axvspan(low, high, color="0.9", label="between the critical speeds")
axis.plot(speeds, np.sqrt(modes.fast), label="fast mode", **plot.style(0))
axis.plot(speeds, np.sqrt(np.where(modes.slow >= 0, modes.slow, np.nan)), label="slow mode", **plot.style(1))
axis.plot(speeds, np.sqrt(np.where(modes.slow <= 0, -modes.slow, np.nan)), label="growth rate", **plot.style(2))
axis.set(
    xlabel=r"$\omega$ / (rad/s)",
    ylabel=r"$\Omega$ / (rad/s), or 1/s",
    title="K = 20 N/m, k = 8 N/m, m = 0.5 kg",
    ylim=(-0.5, 23),
)
axis.legend(fontsize=9, frameon=False, ncols=2, loc="upper left")
fig

# %% [markdown]
# The critical speeds are 4.000 and 6.325 rad/s. At 2.5 rad/s the frequencies are 2.280 and 7.956 rad/s, and 4.000 and
# 6.325 at rest; at 8 rad/s, above both critical speeds, 2.548 and 13.323 rad/s.

# %%
solved, rates = exact.exact_motion(params, *start, ts)
assert apart < 1e-9 and max(float(jnp.max(jnp.abs(solved[name] - in_turning.q[name]))) for name in solved) < 1e-9
length = float(exact.equilibrium_length(params))
assert abs(length - 0.889) < 5e-4 and length > params["R0"]
at_rest = lj.accelerations(turning, 0.0, {"R": length, "r": 0.0}, {"R": 0.0, "r": 0.0}, params)[0]
assert all(abs(float(a)) < 1e-12 for a in at_rest.values())
assert np.ptp(h) < 1e-9 and np.max(np.abs(h - (E - params["omega"] * L_z))) < 1e-9
assert np.max(np.abs(h - (E - swirl - spread))) < 1e-9
assert np.ptp(E) > 0.5 and np.ptp(printed) > 0.5, "the printed one"
assert kept["2"] < 1e-9 and kept["1"] < 1e-9, "both conserve h'"
assert jnp.max(distance["factor 2"]) < 1e-9
assert abs(jnp.max(distance["factor 1, as printed"][ts < 1.0]) - 0.17) < 5e-3
assert all(swept.ok.all() for swept in maps.values())
assert against["factor 2"] == 0 and against["factor 1, as printed"] > 100
above = (p > 1) & (q > 1)
lost = np.mean(~(maps["factor 1, as printed"].values[above] < 1000.0))
assert lost > 0.5, lost
for speed, slow, fast in ((0.0, 4.0, 6.325), (2.5, 2.280, 7.956), (8.0, 2.548, 13.323)):
    square = exact.mode_squares(params | {"omega": speed})
    assert abs(float(square.slow) ** 0.5 - slow) < 5e-4 and abs(float(square.fast) ** 0.5 - fast) < 5e-4
assert abs(low - 4.0) < 1e-12 and abs(high - 6.325) < 5e-4
