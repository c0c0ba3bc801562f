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
# # Why does the hoop let go of the cylinder?
#
# A hoop of mass $m$ and radius $a$ rolls down a fixed cylinder of radius $R$ (Goldstein, Exercise 2-14). Its centre
# has the polar coordinates $r$, $\theta$, with $\theta$ counted from the horizontal; $\phi$ is the hoop's own angle.
# Two constraints hold it, and their multipliers are forces:
#
# - contact, $r - (R + a) = 0$, with the normal force $\lambda$;
# - rolling, $(R + a)\,\dot\theta + a\,\dot\phi = 0$, with the friction force $\mu$.

# %%
import diffrax
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import rolling_hoop as exact

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def lagrangian(t, q, v, params):
    m, a, g = params["m"], params["a"], params["g"]
    centre = 0.5 * m * (v["r"] ** 2 + (q["r"] * v["theta"]) ** 2)
    spin = 0.5 * m * (a * v["phi"]) ** 2
    return centre + spin - m * g * q["r"] * jnp.sin(q["theta"])


def contact(t, q, params):
    return q["r"] - (params["R"] + params["a"])


def rolling(t, q, v, params):
    return (params["R"] + params["a"]) * v["theta"] + params["a"] * v["phi"]


held = lj.Holonomic(contact)
hoop = lj.System(lagrangian, constraints={"contact": held, "rolling": lj.Nonholonomic(rolling)})
params = {"m": 1.25, "R": 1.0, "a": 0.25, "g": 9.8125}  # kg, m, m, m/s²
length, weight = params["R"] + params["a"], params["m"] * params["g"]

# %% [markdown]
# ## The normal force goes through zero
#
# The model keeps the constraints satisfied at all times. So let the hoop roll from near the top down to the side and
# look at the forces that this requires.


# %%
def at(theta, theta_rate):
    """A rolling state."""
    q = {"r": length + 0 * theta, "theta": theta, "phi": 0 * theta}
    return q, {"r": 0 * theta, "theta": theta_rate, "phi": -length / params["a"] * theta_rate}


def rate_from_the_top(theta):
    """Energy: θ̇² = g (1 - sin θ) / (R + a), the limit of starts from rest ever nearer to the top."""
    return -np.sqrt(params["g"] / length * (1 - np.sin(theta)))


first = np.radians(88.0)
ts = jnp.linspace(0.0, 1.9, 39)
rolled = lj.integrate(hoop, *at(first, rate_from_the_top(first)), params, ts=ts, rtol=1e-11, atol=1e-11)
rolled

# %%
theta = np.linspace(np.radians(90.0), np.radians(5.0), 171)
fig, axes = plot.figure(size=(6.0, 3.6))
axis = axes[0, 0]
curves = {
    "contact": (r"normal force $\lambda = m g\,(2\sin\theta - 1)$", 2 * np.sin(theta) - 1),
    "rolling": (r"friction $\mu = \frac{1}{2}\,m g\cos\theta$", np.cos(theta) / 2),
}
for i, (name, (label, curve)) in enumerate(curves.items()):
    axis.plot(np.degrees(theta), curve, label=label, **plot.style(i))
    axis.plot(
        np.degrees(rolled.q["theta"]),
        rolled.multipliers[name] / weight,
        plot.MARKERS[i],
        color=plot.COLOURS[i],
        markersize=4,
    )
axis.axhline(0.0, color="black", linewidth=0.8)
axis.axvline(30.0, color="0.5", linewidth=0.8)
axis.text(29.5, 0.8, "the cylinder\nwould have to pull", fontsize=9)
axis.set(
    xlabel=r"$\theta$ / degrees from the horizontal", ylabel="force / (m g)", title="Lines: closed form. Marks: lagjax"
)
axis.invert_xaxis()
axis.legend(fontsize=9, frameon=False, loc="lower left")
fig

# %% [markdown]
# The multipliers agree with their closed forms. A cylinder pushes; it cannot pull. At 30° $\lambda$ becomes negative,
# and the hoop leaves.
#
# The solution that this notebook follows says that the formula for $\lambda$ gives a negative value "at the bottom,
# when $\theta = 0$". The value is negative, but $\theta = 0$ is not the bottom: the centre's height is $r \sin\theta$.
# Compute at both places the force that would hold the hoop there.

# %%
names = {"the side": 0.0, "the bottom": -np.pi / 2}
forces, heights = {}, {}
for name, angle in names.items():
    q, v = at(np.asarray(angle), rate_from_the_top(angle))
    forces[name] = float(lj.accelerations(hoop, 0.0, q, v, params)[1]["contact"]) / weight
    heights[name] = float(q["r"] * np.sin(q["theta"])) / length
    print(f"theta = {np.degrees(angle):5.1f} deg: height {heights[name]:+.3f} (R + a), normal force "
          f"{forces[name]:+.3f} m g: {name}")  # fmt: skip

# %% [markdown]
# So $-mg$ is the value at the side; at the bottom it is $-3mg$.
#
# ## The departure is an event
#
# After the constraints $r = R + a$ and $\dot\phi = -(R + a)\,\dot\theta/a$ are inserted, the Lagrangian contains only
# $\theta$, with the inertia $2 m (R + a)^2$, and the normal force is $N = m g\sin\theta - m (R + a)\,\dot\theta^2$. The
# departure is the event $N = 0$. (A hoop that slides has the inertia $m (R + a)^2$, and friction with the coefficient
# $c$ drags its centre with $c N$. That will be needed below; one sweep computes all departures.)


# %%
def angle_alone(t, q, v, params):
    return 0.5 * params["inertia"] * params["m"] * (length * v) ** 2 - params["m"] * params["g"] * length * jnp.sin(q)


def normal(q, v, params):
    return params["m"] * (params["g"] * jnp.sin(q) - length * v**2)


def drag(t, q, v, params):
    return params["c"] * normal(q, v, params) * length


one_angle = lj.System(angle_alone, force=drag)
no_push = diffrax.Event(lambda t, y, params, **kwargs: normal(*y, params), direction=False)


def depart(point):
    changed = params | {"inertia": point["inertia"], "c": point["c"]}
    settings = {"ts": jnp.array([0.0, 20.0]), "rtol": 1e-11, "atol": 1e-13, "event": no_push}
    end = lj.integrate(one_angle, point["theta"], point["rate"], changed, **settings).end
    return {"t": end.t, "theta": end.q}


tilts, friction = np.geomspace(1e-6, 0.5, 20), 2.0 ** np.arange(-4.0, 4.1, 0.5)
slips = np.arcsin((8 * friction**2 + np.sqrt(1 + 12 * friction**2)) / (1 + 16 * friction**2))
starts = {
    "theta": np.concatenate([[first], np.pi / 2 - tilts, slips]),
    "rate": np.concatenate([[rate_from_the_top(first)], 0 * tilts, rate_from_the_top(slips)]),
    "inertia": np.concatenate([[2.0], 2 + 0 * tilts, 1 + 0 * slips]),
    "c": np.concatenate([[0.0], 0 * tilts, friction]),
}
swept = lj.sweep(depart, starts, paired=True, progress=False)
parts = (0, slice(1, 21), slice(21, None))
left, released, slid = ({name: x[part] for name, x in swept.values.items()} for part in parts)
print(swept)
print(f"from the top the hoop leaves at {np.degrees(left['theta']):.9f} degrees")

# %% [markdown]
# ## From rest at the top it never leaves
#
# The same solution starts the hoop "from rest at the top". There it would stay forever. Released from rest at a tilt
# $\delta$ it leaves at $\sin\theta_d = \frac{1}{2}\cos\delta$, after a time that grows as $\ln(1/\delta)$. Thirty
# degrees is only a limit.

# %%
times = exact.departure_time(params | {"beta": 1.0}, tilts)
w = np.sqrt(params["g"] / (2 * length))
logarithm = np.log(8 * np.tan(np.radians(15)) / tilts) / w
fig, axes = plot.figure(size=(6.0, 3.2))
axis = axes[0, 0]
axis.semilogx(tilts, times, label=r"exact, Carlson's $R_F$", linewidth=3.5, color=plot.COLOURS[5])
axis.semilogx(tilts, logarithm, label=r"$\ln(8\tan 15°/\delta)\,/\,w$", **plot.style(1))
axis.semilogx(tilts, released["t"], "o", color="black", markersize=4, label="lagjax")
axis.set(xlabel=r"tilt at the start $\delta$ / rad", ylabel="leaves after t / s", title="The top is an equilibrium")
axis.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# ## The gap opens slowly
#
# Without constraints the same Lagrangian describes free flight. Because $\lambda = 0$, the flight starts with the
# velocity *and* the radial acceleration of the rolling motion, so the gap opens only as $t^3$. Watch the force, not the
# distance.

# %%
free = lj.System(lagrangian)
after = jnp.concatenate([jnp.zeros(1), jnp.geomspace(1e-3, 0.4, 25)])
flown = lj.integrate(
    free, *at(left["theta"], rate_from_the_top(left["theta"])), params, ts=after, rtol=1e-12, atol=1e-14
)
speed, angle = np.sqrt(params["g"] * length / 2), np.radians(30.0)
cubic = params["g"] * speed * np.cos(angle) / (2 * length)
gap = np.sqrt(length**2 + 2 * length * cubic * after**3 + params["g"] ** 2 * after**4 / 4) - length
fig, axes = plot.figure(1, 2, size=(4.4, 3.9))
ax, right = axes[0]
around = np.linspace(0.0, 2 * np.pi, 181)
ax.fill(np.cos(around), np.sin(around), facecolor="0.88", edgecolor="0.4")
rolls = np.linspace(first, left["theta"], 50)
for i, (name, r, angles) in enumerate((("rolls", length, rolls), ("flies", flown.q["r"], flown.q["theta"]))):
    x, y = r * np.cos(angles), r * np.sin(angles)
    ax.plot(x, y, label=name, **plot.style(i))
    for k in (0, -1):
        ax.plot(x[k] + 0.25 * np.cos(around), y[k] + 0.25 * np.sin(around), color=plot.COLOURS[i], linewidth=0.9)
ax.plot([0.0, 1.6 * np.cos(angle)], [0.0, 1.6 * np.sin(angle)], color="0.4", linewidth=0.8)
ax.text(1.42, 0.83, "30°", fontsize=9)
ax.set(xlabel="x / m", ylabel="y / m", aspect="equal", title="Rolls, then flies", xlim=(-0.4, 2.1), ylim=(-1.4, 1.6))
ax.legend(fontsize=9, frameon=False, loc="upper right")
right.loglog(after[1:], cubic * after[1:] ** 3, label=r"$g\,v\cos 30°\;t^3\,/\,2(R+a)$", **plot.style(1))
right.loglog(after[1:], flown.q["r"][1:] - length, "o", color="black", markersize=4, label="lagjax")
right.set(xlabel="time since the departure t / s", ylabel="gap / m", title="A gap that opens as t³")
right.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# ## With real friction it slips first
#
# Reaching thirty degrees needs unlimited friction. Near the departure $\mu$ is finite and $\lambda$ is no longer there
# to support it: $\mu/\lambda = \cos\theta\,/\,[2\,(2\sin\theta - 1)] \to \infty$. On a surface with the coefficient $c$
# the hoop starts to slip where this ratio is $c$,
#
# $$\sin\theta_s = \frac{8c^2 + \sqrt{1 + 12c^2}}{1 + 16c^2},$$
#
# and from there on the hoop slides. Its departure has a closed form too: $u = (R+a)\,\dot\theta^2/g$ obeys the linear
# equation $\mathrm{d}u/\mathrm{d}\theta = -2\cos\theta + 2c\,(\sin\theta - u)$, and $N = 0$ is $u = \sin\theta$.


# %%
def forced(theta):
    return ((4 * friction**2 - 2) * np.sin(theta) - 6 * friction * np.cos(theta)) / (1 + 4 * friction**2)


leaves_at = slid["theta"]
fading = np.exp(-2 * friction * (leaves_at - slips))
u = forced(leaves_at) + (1 - np.sin(slips) - forced(slips)) * fading
print(f"u - sin θ at the departures: {np.max(np.abs(u - np.sin(leaves_at))):.0e}")

fig, axes = plot.figure(1, 2, size=(4.6, 3.5))
ax, right = axes[0]
before = np.linspace(np.radians(89.7), np.radians(30.6), 300)
ax.semilogy(np.degrees(before), np.cos(before) / (4 * np.sin(before) - 2), label="closed form", **plot.style(0))
holds = rolled.multipliers["contact"] > 0
ratio = rolled.multipliers["rolling"][holds] / rolled.multipliers["contact"][holds]
ax.semilogy(np.degrees(rolled.q["theta"][holds]), ratio, "o", color="black", markersize=4, label="lagjax")
ax.axvline(30.0, color="0.5", linewidth=0.8)
for c in (0.25, 1.0):
    slip = np.degrees(slips[np.argmin(np.abs(friction - c))])
    ax.plot([90.0, slip], [c, c], color=plot.COLOURS[1], linestyle="--", linewidth=1.2)
    ax.text(89.0, 1.12 * c, f"c = {c:g} slips at {slip:.2f}°", fontsize=9)
ax.set(
    xlabel=r"$\theta$ / degrees", ylabel=r"$\mu\,/\,\lambda$", title="The friction that rolling takes", ylim=(0.01, 60)
)
ax.invert_xaxis()
ax.legend(fontsize=9, frameon=False)
right.semilogx(friction, np.degrees(slips), marker="s", markersize=4, label="slips", **plot.style(1))
right.semilogx(friction, np.degrees(leaves_at), marker="o", markersize=4, label="leaves", **plot.style(0))
for level, x, words in ((30.0, 0.06, "unlimited friction: 30°"), (np.degrees(np.arcsin(2 / 3)), 2.6, "none: 41.81°")):
    right.axhline(level, color="0.5", linewidth=0.8)
    right.text(x, level + 0.8, words, fontsize=9)
right.set(
    xlabel="coefficient of friction c", ylabel=r"$\theta$ / degrees", title="It slips, and then leaves", ylim=(28, 86)
)
right.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# ## Rolls, slips, flies: one motion
#
# That needed an equation derived by hand. The multipliers make it unnecessary: each phase is a system with its own
# constraints, friction is a force that depends on a multiplier, and a switch ends a phase when a guard crosses zero.


# %%
def sliding_friction(t, q, v, multipliers, params):
    pulled = params["c"] * multipliers["contact"]  # forward, against a contact that slides downhill
    return {"r": 0.0, "theta": length * pulled, "phi": params["a"] * pulled}


slippery = lj.Hybrid(
    {
        "rolls": hoop,
        "slips": lj.System(lagrangian, constraints={"contact": held}, force=sliding_friction),
        "flies": free,
    },
    [
        lj.Switch(
            "rolls", to="slips", when=lj.guards.slips("rolling", on="contact", coefficient=lambda p: p["c"], side=1)
        ),
        lj.Switch("slips", to="flies", when=lj.guards.releases("contact")),
    ],
    most_switches=2,
)
until = jnp.linspace(0.0, 2.2, 89)


def whole(c):
    return lj.integrate(slippery, *at(first, rate_from_the_top(first)), params | {"c": c}, ts=until, rtol=1e-10)


in_phases = whole(0.25)
print(in_phases)
found = np.array([whole(c).switches.q["theta"] for c in friction])

# %%
fig, axes = plot.figure(1, 2, size=(4.6, 3.5))
ax, right = axes[0]
for i, name in enumerate(slippery.names):
    mine = np.asarray(in_phases.phase) == i
    ax.plot(until[mine], np.degrees(in_phases.v["phi"][mine]) / 360, label=f"{name}: spin", **plot.style(i))
on_it = np.asarray(in_phases.phase) < 2
rolling_spin = -length / params["a"] * in_phases.v["theta"][on_it]
ax.plot(until[on_it], np.degrees(rolling_spin) / 360, ":", color="black", linewidth=1.2, label="rolling would take")
ax.set(xlabel="t / s", ylabel="turns a second", title="c = 1/4: it turns too slowly to roll")
ax.legend(fontsize=9, frameon=False)
for i, (name, exact_angle) in enumerate((("slips", slips), ("leaves", leaves_at))):
    right.semilogx(friction, np.degrees(exact_angle), label=f"{name}, as above", **plot.style(1 - i))
    right.semilogx(friction, np.degrees(found[:, i]), "o", color="black", markersize=4)
right.set(xlabel="coefficient of friction c", ylabel=r"$\theta$ / degrees", title="Marks: the motion in phases")
right.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# With $c = 1/4$ the hoop slips at 65.70° and leaves at 36.63°; with $c = 1$ at 43.05° and 32.43°. "This is the angle
# at which the hoop falls from the cylinder, $\theta = 30°$", says the solution. For every finite coefficient this is
# wrong: the hoop leaves between 30° and 41.81°, because the normal force goes to zero; and it slips before that,
# because the friction force goes to zero with it.

# %%
on_the_way, rate = (np.asarray(x["theta"]) for x in (rolled.q, rolled.v))
assert np.allclose(rolled.multipliers["contact"], weight * (2 * np.sin(on_the_way) - 1), rtol=0, atol=1e-8)
assert np.allclose(rolled.multipliers["contact"], normal(on_the_way, rate, params), rtol=0, atol=1e-8)
assert np.allclose(rolled.multipliers["rolling"], weight * np.cos(on_the_way) / 2, rtol=0, atol=1e-8)
assert np.all((rolled.multipliers["contact"] < 0) == (np.degrees(on_the_way) < 30))
assert swept.ok.all() and abs(np.degrees(left["theta"]) - 30.0) < 1e-8
assert abs(forces["the side"] + 1) < 1e-12 and abs(heights["the side"]) < 1e-12
assert abs(forces["the bottom"] + 3) < 1e-12 and abs(heights["the bottom"] + 1) < 1e-12
assert np.max(np.abs(released["t"] / times - 1)) < 1e-7 and np.max(np.abs(logarithm / times - 1)[:12]) < 1e-6
assert np.max(np.abs(np.sin(released["theta"]) - np.cos(tilts) / 2)) < 1e-9
assert np.max(np.abs(flown.q["r"] - length - gap)) < 1e-9
assert abs((flown.q["r"][1] - length) / (cubic * 1e-9) - 1) < 2e-3
assert np.max(np.abs(u - np.sin(leaves_at))) < 1e-9
assert np.max(np.abs(found - np.stack([slips, leaves_at], axis=1))) < 1e-8
assert np.allclose(np.cos(slips), 2 * friction * (2 * np.sin(slips) - 1), rtol=1e-12)
for c, slip, leave in ((0.25, 65.70, 36.63), (1.0, 43.05, 32.43)):
    i = np.argmin(np.abs(friction - c))
    assert abs(np.degrees(slips[i]) - slip) < 5e-3 and abs(np.degrees(leaves_at[i]) - leave) < 5e-3
assert np.all((30.0 < np.degrees(leaves_at)) & (np.degrees(leaves_at) < 41.811) & (leaves_at < slips))
