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
# # What comes back?
#
# Some motions return to their start; one period then describes them completely. `lj.periodic_orbit` finds them,
# `lj.floquet` says whether neighbouring motions stay near, and `lj.lyapunov_exponents` describes motions that never
# return.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from scipy import special

import lagjax as lj
from lagjax.display import plots as plot

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures

# %% [markdown]
# ## An attracting cycle
#
# Van der Pol's oscillator gains energy at small deflections and loses it at large ones. From a guess of its size and
# period, Newton's method on the flow finds the cycle; the period is known to 16 digits, 6.663286859323130.


# %%
def spring(t, q, v, params):
    return 0.5 * v**2 - 0.5 * q**2


def valve(t, q, v, params):
    return params["mu"] * (1.0 - q**2) * v


oscillator = lj.System(spring, force=valve)
cycle = lj.periodic_orbit(oscillator, (2.0, 0.0), 6.0, {"mu": 1.0})
cycle

# %%
multipliers = lj.floquet(cycle)
multipliers

# %% [markdown]
# One multiplier is 1 because the cycle may start at any of its points. The other says that after one period a
# neighbouring motion is nearer by a factor of a thousand. By Liouville's formula their product must be
# $\exp\oint \mu(1 - q^2)\,dt$, which is integrated along with the motion. Derivatives come from the implicit function
# theorem:


# %%
def period(mu):
    return lj.periodic_orbit(oscillator, (2.0, 0.0), 6.0, {"mu": mu}).period


slope = jax.jit(jax.jacfwd(period))(1.0)
print(f"dT/dμ = {float(slope):.9f}")

# %%
run = jax.vmap(lambda q0: lj.integrate(oscillator, q0, 0.0, {"mu": 1.0}, ts=jnp.linspace(0.0, 7.0, 281)))
neighbours = run(jnp.array([0.3, 3.2]))
fig, axes = plot.figure(size=(5.0, 3.6))
axis, around = axes[0, 0], cycle.trajectory
for q, v in zip(neighbours.q, neighbours.v):
    axis.plot(q, v, linewidth=1.0, color=plot.COLOURS[5])
axis.plot(around.q, around.v, linewidth=2.0, color=plot.COLOURS[0])
axis.set(xlabel="q", ylabel="v", title="Two motions that join the cycle")
fig

# %% [markdown]
# ## A pendulum that stands upright
#
# A pendulum whose pivot is shaken up and down can stand upright (Stephenson 1908, Kapitza 1951). For an equilibrium of
# a driven system no orbit has to be found: the state of rest returns after every period of the drive. With
# $a = -4g/(l\Omega^2)$ and $q = 2A/l$ small motions obey Mathieu's equation, and the pendulum stands where
# $a > a_0(q)$.


# %%
def shaken(t, q, v, params):
    g, l, amplitude, rate = (params[name] for name in ("g", "l", "amplitude", "rate"))
    lift = -amplitude * rate * jnp.sin(rate * t)  # of the pivot, upward; q = 0 is upright
    kinetic = 0.5 * (l * v) ** 2 - l * v * jnp.sin(q) * lift + 0.5 * lift**2
    return kinetic - g * l * jnp.cos(q)


pendulum = lj.System(shaken)
toy = {"g": 9.81, "l": 0.25, "amplitude": 0.025}


def upright(rate):
    return lj.floquet(pendulum, 0.0, 0.0, 0.0, {**toy, "rate": rate}, 2 * jnp.pi / rate)


edge = np.sqrt(-4 * toy["g"] / toy["l"] / special.mathieu_a(0, 2 * toy["amplitude"] / toy["l"]))
print(f"by Mathieu's function it stands from Ω = {edge:.6f} on")
for rate in (0.999 * edge, 1.001 * edge):
    print(f"Ω = {rate:.3f}: {upright(rate).verdict}")

# %% [markdown]
# Now the whole stability chart of Mathieu's equation, $\ddot x + (a - 2q\cos 2t)\,x = 0$: a sweep over twenty thousand
# systems with one verdict each. The lines are the characteristic values; the computation does not use them.


# %%
def mathieu(t, q, v, params):
    return 0.5 * v**2 - 0.5 * (params["a"] - 2 * params["q"] * jnp.cos(2 * t)) * q**2


swing = lj.System(mathieu)
grid = {"a": jnp.linspace(-3.0, 10.0, 201), "q": jnp.linspace(0.0, 6.0, 101)}
chart = lj.sweep(lambda at: lj.floquet(swing, 0.0, 0.0, 0.0, at, jnp.pi).stable, grid, progress=False)
chart

# %%
fig, axes = plot.figure(size=(6.4, 4.0))
axis, strength = axes[0, 0], np.linspace(0.0, 6.0, 201)
stable = np.asarray(chart.values).astype(float)
axis.pcolormesh(grid["a"], grid["q"], stable.T, cmap="Blues", vmin=0.0, vmax=2.2, shading="nearest")
for order in range(4):
    axis.plot(special.mathieu_a(order, strength), strength, linewidth=1.0, color=plot.COLOURS[1])
    if order:
        axis.plot(special.mathieu_b(order, strength), strength, linewidth=1.0, color=plot.COLOURS[1])
axis.set(xlim=(-3.0, 10.0), ylim=(0.0, 6.0), xlabel="a", ylabel="q", title="Stable where blue")
axis.grid(False)
fig

# %% [markdown]
# ## Motions that do not return
#
# A star moves in a galaxy, in the model of Hénon and Heiles (1964). A Poincaré section shows where motions of one
# energy pass $x = 0$: some draw curves, one fills an area. At the centres of the curves are periodic motions.


# %%
def galaxy(t, q, v, params):
    x, y = q["x"], q["y"]
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - 0.5 * (x**2 + y**2) - x**2 * y + y**3 / 3


star, energy = lj.System(galaxy), 0.125


def thrown(y, vy):
    vx = jnp.sqrt(2 * energy - y**2 + 2 * y**3 / 3 - vy**2)
    return {"x": 0.0 * y, "y": y}, {"x": vx, "y": 0.0 * y + vy}


starts = np.array([[-0.25, 0.0], [0.0, 0.3], [0.1, 0.0], [0.2, 0.0], [0.45, 0.1], [0.55, 0.0], [0.0, 0.12]])
through = lj.Crossing(lambda t, q, v, params: q["x"], direction=1, terminal=False, most=220)


@jax.jit
@jax.vmap
def sections(start):
    return lj.poincare(star, *thrown(*start), section=through, ts=np.array([0.0, 1100.0]), rtol=1e-8)


section = sections(starts)
loop = lj.periodic_orbit(star, thrown(0.3, 0.0), 6.0)
loop

# %%
lj.floquet(loop)

# %%
parting = {
    name: lj.lyapunov_exponents(star, *thrown(*start), ts=np.linspace(0.0, 3000.0, 1501), count=2)
    for name, start in (("curve", starts[3]), ("area", starts[0]))
}
parting["area"]

# %%
fig, axes = plot.figure(1, 2, size=(4.6, 3.8))
left, right = axes[0]
for i, (y, vy) in enumerate(zip(section.q["y"], section.v["y"])):
    left.plot(y, vy, ".", markersize=1.8, color=plot.COLOURS[i % len(plot.COLOURS)])
left.plot(loop.q["y"], loop.v["y"], "*", markersize=11, color="black")
left.set(xlabel="y", ylabel="vy", title="Where motions pass x = 0; a star comes back")
for i, (name, found) in enumerate(parting.items()):
    right.loglog(found.t[1:], jnp.abs(found.running()[:, 0]), label=name, **plot.style(i))
right.set(xlabel="t", ylabel="mean growth of a distance", title="The largest Lyapunov exponent")
right.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# On a curve the mean growth rate falls like $1/t$: neighbouring motions separate like $t$, and the exponent is zero. In
# the area it stays positive. Its uncertainty, for a motion of this length, is estimated from the spread of its parts.

# %%
for name, found in parting.items():
    print(f"{name}: {float(found.exponents[0]):.4f} ± {float(found.uncertainty[0]):.4f}")

# %%
assert abs(float(cycle.period) - 6.663286859323130) < 1e-11
assert abs(float(multipliers.product) - float(multipliers.liouville)) < 1e-8
assert not upright(0.999 * edge).stable and upright(1.001 * edge).stable
assert bool(loop.converged) and bool(lj.floquet(loop).stable)
assert bool(parting["area"].sensitive) and not bool(parting["curve"].sensitive)
