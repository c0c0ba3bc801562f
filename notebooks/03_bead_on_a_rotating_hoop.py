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
# # Bead on a rotating hoop: where does it go when the hoop turns faster?
#
# A bead of mass $m$ slides without friction on a hoop of radius $a$, which a motor turns about its vertical diameter
# with the angular velocity $\omega$ (Goldstein, Exercise 2-18). $\psi$ is the bead's angle from the bottom. With
# $\omega_0^2 = g/a$ there is one critical speed, $\omega_0$.

# %%
import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import bead_on_hoop as exact

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def lagrangian(t, q, v, params):
    m, a, g, omega = params["m"], params["a"], params["g"], params["omega"]
    return 0.5 * m * a**2 * (v**2 + (omega * jnp.sin(q)) ** 2) + m * g * a * jnp.cos(q)


def friction(t, q, v, params):
    return 0.5 * params["b"] * (params["a"] * v) ** 2


bead = lj.System(lagrangian)
with_friction = lj.System(lagrangian, dissipation=friction)
params = {"m": 0.5, "a": 0.75, "g": 9.8125, "omega": 6.0}  # kg, m, m/s², rad/s
unit = float(np.sqrt(params["g"] / params["a"]))  # ω0, rad/s

# %% [markdown]
# ## One valley becomes two
#
# The terms of $L$ without $\dot\psi$ are minus an effective potential,
# $V_\mathrm{eff} = -m g a\cos\psi - \frac{1}{2} m a^2\omega^2 \sin^2\psi$. Above $\omega_0$ the bottom is a maximum
# between two minima at $\cos\alpha = \omega_0^2/\omega^2$.

# %%
psi = np.linspace(-np.pi, np.pi, 361)
fig, axes = plot.figure(size=(5.4, 3.0))
axis = axes[0, 0]
for i, speed in enumerate((0.5, 1.0, 2.0)):
    at_rest = lambda angle: -lagrangian(0.0, angle, 0.0, params | {"omega": speed * unit})
    height = jax.vmap(at_rest)(psi) / (params["m"] * params["g"] * params["a"])
    axis.plot(np.degrees(psi), height, label=rf"$\omega = {speed:g}\,\omega_0$", **plot.style(i))
axis.set(xlabel=r"angle $\psi$ / degrees", ylabel=r"$V_\mathrm{eff}\,/\,m g a$", title="The hoop as seen by the bead")
axis.set_xticks(range(-180, 181, 60))
axis.legend(fontsize=9, frameon=False, loc="upper center")
fig

# %% [markdown]
# ## A pitchfork
#
# With some friction the bead comes to rest. Here are 46 beads, each released at rest at 0.5 rad on one side or the
# other of a hoop with its own speed, and their positions 40 s later:

# %%
speeds = np.concatenate([np.linspace(0.1, 0.9, 9), np.linspace(1.12, 2.5, 14)])
sides = np.array([-0.5, 0.5])


def settle(point):
    turning = params | {"omega": point["speed"] * unit, "b": 2.0}  # b in kg/s
    return lj.integrate(
        with_friction, point["start"], 0.0, turning, ts=jnp.array([0.0, 40.0]), rtol=1e-7, atol=1e-7
    ).end.q


settled = lj.sweep(settle, {"speed": speeds, "start": sides}, progress=False)
tilt = np.arccos(np.minimum(1.0, speeds**-2.0))
off = np.abs(settled.values - np.sign(sides) * tilt[:, None])
print(settled)
print(f"farthest from the pitchfork: {off.max():.0e} rad")

fig, axes = plot.figure(size=(5.4, 3.0))
axis, above = axes[0, 0], np.linspace(1.0, 2.5, 300)
branch = np.degrees(np.arccos(above**-2.0))
axis.plot(np.append(0.0, above), np.append(0.0, branch), label="stable", **plot.style(0))
axis.plot(above, -branch, **plot.style(0))
axis.plot([1.0, 2.5], [0.0, 0.0], label="unstable", **plot.style(1))
for i, name in enumerate(("released at -0.5 rad", "released at +0.5 rad")):
    axis.plot(speeds, np.degrees(settled.values[:, i]), "v^"[i], color="black", markersize=4, label=name)
axis.set(xlabel=r"$\omega\,/\,\omega_0$", ylabel=r"angle $\psi$ / degrees", title="Where the bead comes to rest")
axis.legend(fontsize=9, frameon=False, loc="upper left")
fig

# %% [markdown]
# ## Three kinds of motion
#
# Without friction, at $\omega = 1.66\,\omega_0$, the bead moves about one valley, through both, or over the top. The
# Jacobi integral $h = \frac{1}{2} m a^2\dot\psi^2 + V_\mathrm{eff}$ distinguishes them: below $-m g a$, between, and
# above $+m g a$.

# %%
starts = {
    "psi": np.array([0.55, 0.8, -0.55, -0.8, 2.0, 2.6, -np.pi, np.pi, -np.pi]),
    "rate": np.array([0.0] * 6 + [6.0, -6.0, 6.0]),
    "omega": np.append(np.full(8, params["omega"]), 0.5 * unit),
}
weight = params["m"] * params["g"] * params["a"]
all_params = params | {"omega": starts["omega"]}
h_start = np.asarray(exact.balance(all_params, starts["psi"], starts["rate"]).h)
kinds = np.searchsorted([-weight, weight], h_start)
rotation = exact.rotation_period(all_params, np.maximum(2 * h_start, 2.1 * weight) / (params["m"] * params["a"] ** 2))
once = np.where(kinds == 2, rotation, exact.exact_period(all_params, starts["psi"]))


def free(point):
    ts, turning = jnp.linspace(0.0, 1.0, 81) * point["period"], params | {"omega": point["omega"]}
    return lj.integrate(bead, point["psi"], point["rate"], turning, ts=ts, rtol=1e-11, atol=1e-11)


portrait = lj.sweep(free, starts | {"period": once}, paired=True, progress=False).values
h = np.asarray(exact.balance(params | {"omega": starts["omega"][:, None]}, portrait.q, portrait.v).h)
grid_psi, grid_rate = np.meshgrid(np.linspace(-np.pi, np.pi, 241), np.linspace(-14.0, 14.0, 241))
height = exact.balance(params, grid_psi, grid_rate).h / weight
names = ("about one valley", "through both", "over the top")
fig, axes = plot.figure(size=(6.0, 3.0))
axis = axes[0, 0]
grey = {"colors": "0.55", "linewidths": 1.0, "linestyles": "solid"}
axis.contour(np.degrees(grid_psi), grid_rate / unit, height, levels=[-1.0, 1.0], **grey)
for lane, kind in enumerate(kinds[:8]):
    label = names[kind] if kind not in kinds[:lane] else None
    axis.plot(np.degrees(portrait.q[lane]), portrait.v[lane] / unit, label=label, **plot.style(kind))
axis.plot([], [], color="0.55", linewidth=1.0, label=r"$h = \pm m g a$")
axis.set(
    xlabel=r"angle $\psi$ / degrees", ylabel=r"$\dot\psi\,/\,\omega_0$", title="Lines of constant h", xlim=(-180, 180)
)
axis.set_xticks(range(-180, 181, 60))
axis.legend(fontsize=9, frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# The solution that this notebook follows says that for $a\omega^2/g < 1$ the bead oscillates about the bottom,
# "unless it starts there with zero velocity". With $h > m g a$ it does not: it goes over the top at any speed of the
# hoop, and the ninth lane of the sweep did so at $\omega = 0.5\,\omega_0$.
#
# ## At the critical speed nothing is harmonic
#
# The same solution takes small oscillations for harmonic "if the angular velocity is not larger than
# $\omega_0^2 = g/a$". That allows $\omega = \omega_0$, and compares a velocity with the square of a velocity. A
# harmonic period does not depend on the amplitude. Half a period is the time until the bead rests again:

# %%
rests = diffrax.Event(lambda t, y, params, **kwargs: y[1], direction=False)


def period(point):
    turning = params | {"omega": point["speed"] * unit}
    span = jnp.array([0.0, 400.0])
    half = lj.integrate(bead, -point["amplitude"], 0.0, turning, ts=span, rtol=1e-11, atol=1e-13, event=rests).end.t
    return 2 * half * unit / (2 * jnp.pi)


slow, amplitudes = np.array([0.5, 0.9, 1.0]), np.geomspace(0.01, 1.0, 13)
periods = lj.sweep(period, {"speed": slow, "amplitude": amplitudes}, progress=False)
elliptic = np.stack([exact.exact_period(params | {"omega": s * unit}, amplitudes) * unit / (2 * np.pi) for s in slow])
critical = periods.values[2] * amplitudes * 2 * np.pi
fig, axes = plot.figure(size=(5.4, 3.0))
axis = axes[0, 0]
for i, speed in enumerate(slow):
    axis.loglog(amplitudes, elliptic[i], label=rf"$\omega = {speed:g}\,\omega_0$", **plot.style(i))
    axis.loglog(amplitudes, periods.values[i], plot.MARKERS[i], color=plot.COLOURS[i], markersize=4)
axis.set(xlabel=r"amplitude $\psi_m$ / rad", ylabel=r"period $\times\;\omega_0\,/\,2\pi$")
axis.set_title("Lines: elliptic integrals. Marks: lagjax")
axis.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# Below $\omega_0$ the period levels off at small amplitudes, at $1/\sqrt{1 - \omega^2/\omega_0^2}$ times that of the
# pendulum. At $\omega_0$ it does not: it is $10.488\,/\,(\omega_0\psi_m)$, as for a restoring force proportional to the
# cube of the angle. So the condition is $\omega < \omega_0$.
#
# ## What the motor does
#
# Let the hoop's own angle $\theta$ be a coordinate, and let $\theta - \omega t = 0$ be a constraint. Its multiplier is
# the motor's torque $\tau$.


# %%
def on_a_free_hoop(t, q, v, params):
    m, a, g = params["m"], params["a"], params["g"]
    rate_squared = v["psi"] ** 2 + (jnp.sin(q["psi"]) * v["theta"]) ** 2
    return 0.5 * m * a**2 * rate_squared + m * g * a * jnp.cos(q["psi"])


motor = lj.Holonomic(lambda t, q, params: q["theta"] - params["omega"] * t)
driven = lj.System(on_a_free_hoop, constraints={"motor": motor})
start = {"psi": 2.0, "theta": 0.0}, {"psi": 0.0, "theta": params["omega"]}
ts = jnp.linspace(0.0, 2.0, 201)
traj = lj.integrate(driven, *start, params, ts=ts, rtol=1e-11, atol=1e-11)
books = exact.balance(params, traj.q["psi"], traj.v["psi"])
torque = traj.multipliers["motor"]
momenta = jax.vmap(lambda t, q, v: lj.momentum(driven, t, q, v, params))(traj.t, traj.q, traj.v)
step = float(ts[1])
work = params["omega"] * (momenta["theta"] - momenta["theta"][0])  # ω ∫ τ dt
gained = books.E - books.E[0]

fig, axes = plot.figure(1, 2, size=(4.2, 3.0))
left, right = axes[0]
left.plot(ts, gained, label="energy gained", **plot.style(0))
left.plot(ts[::6], work[::6], "o", color="black", markersize=3, label=r"$\omega\,\Delta L_z$, the motor's work")
left.plot(ts, books.h - books.h[0], label="change of h", **plot.style(1))
left.set(xlabel="t / s", ylabel="energy / J", title="The motor pays, and is paid back", ylim=(-9, 6))
left.legend(fontsize=9, frameon=False, loc="upper right")
middle = 0.5 * (ts[1:] + ts[:-1])
right.plot(ts, torque, label=r"$\tau$, the multiplier", **plot.style(0))
right.plot(
    middle[::4],
    jnp.diff(momenta["theta"])[::4] / step,
    "o",
    color="black",
    markersize=3,
    label=r"$\Delta L_z/\Delta t$",
)
right.plot(middle, jnp.diff(momenta["psi"]) / step, label=r"$\Delta p_\psi/\Delta t$", **plot.style(1))
right.set(xlabel="t / s", ylabel="torque / N m", title=r"$\tau$ changes $L_z$, and not $p_\psi$", ylim=(-8, 13))
right.legend(fontsize=9, frameon=False, loc="upper right")
fig

# %% [markdown]
# The energy is not constant, but $h = E - \omega L_z$ is, and the motor supplies the difference.
#
# The solution calls $p_\psi$ "proportional to the angular momentum component $L_z$". It is not:
# $p_\psi = m a^2\dot\psi$ is the component along the horizontal normal of the hoop, $L_z = m a^2\omega\sin^2\psi$,
# and the motor's torque changes only the second. (Nor does $\partial L/\partial\dot\psi \ne 0$ show that $p_\psi$
# changes, as is said there; $\partial L/\partial\psi \ne 0$ does.)
#
# ## Fast rotation
#
# For fast rotation $\alpha \to 90°$. "The mass stays in the center of the hoop", says the solution, for
# $\omega^2 \gg a/g$. But $a/g$ is the square of a time: it is $\omega^2 \gg g/a$; and the bead stays at the *height* of
# the centre, on the rim.

# %%
for name in ("10", "100"):
    fast = params | {"omega": float(name) * unit}
    alpha = float(exact.equilibrium_angle(fast))
    pull = float(lj.accelerations(bead, 0.0, alpha, 0.0, fast)[0])
    axis_distance, below = params["a"] * np.sin(alpha), params["a"] * np.cos(alpha)
    print(f"omega = {name:>3} omega0: {axis_distance:.6f} m from the axis (a = {params['a']} m), "
          f"{below:.6f} m below the centre; it rests there to {abs(pull) / fast['omega'] ** 2:.0e} omega²")  # fmt: skip

# %%
ok = (settled.ok.all(), periods.ok.all())
assert all(ok) and settled.values.size == 46 and off.max() < 1e-5
assert kinds.tolist() == [0, 0, 0, 0, 1, 1, 2, 2, 2] and np.max(np.ptp(h, axis=1)) < 1e-8
turned = portrait.q[:, -1] - portrait.q[:, 0]
assert np.allclose(turned, 2 * np.pi * np.array([0, 0, 0, 0, 0, 0, 1, -1, 1]), rtol=0, atol=1e-8)
assert abs(params["omega"] / unit - 1.66) < 5e-3
assert np.max(np.abs(periods.values / elliptic - 1)) < 1e-8
assert np.allclose(periods.values[:2, 0], 1 / np.sqrt(1 - slow[:2] ** 2), rtol=1e-3)
assert abs(critical[0] - 10.488) < 1e-3 and np.ptp(critical[:5]) < 5e-3
assert np.max(np.abs(torque - books.torque)) < 1e-9 and np.max(np.abs(momenta["theta"] - books.L_z)) < 1e-9
assert np.max(np.abs(gained - work)) < 1e-9 and np.ptp(books.h) < 1e-9 and np.ptp(books.E) > 1.0
assert jnp.min(momenta["psi"]) < -1 < 1 < jnp.max(momenta["psi"]) and jnp.min(momenta["theta"]) > -1e-12
assert np.max(np.abs(jnp.diff(momenta["theta"]) / step - 0.5 * (torque[1:] + torque[:-1]))) < 2e-2
assert abs(axis_distance / params["a"] - 1) < 1e-8 and abs(below - params["a"] * 1e-4) < 1e-9
