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
# # Great circles: which coordinates carry a geodesic over the pole?
#
# The shortest path between two points of a sphere is an arc of a great circle (Goldstein, Derivation 2-4). With the
# colatitude $\psi$ and the azimuth $\theta$, $\mathbf r = R\,(\sin\psi\cos\theta, \sin\psi\sin\theta, \cos\psi)$,
# there are three Lagrangians for it:
#
# - length itself, $l = R\int f\,\mathrm d\theta$ with $f = \sqrt{\sin^2\psi + \psi'^2}$: $\theta$ plays the role of
#   time;
# - the kinetic energy of a free particle in $\psi$ and $\theta$: the arc length $s$ is time;
# - a free particle in space that a constraint keeps on the sphere.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import sphere_geodesic as exact

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures


def length(theta, psi, slope, params):
    return jnp.sqrt(jnp.sin(psi) ** 2 + slope**2)


def on_the_map(s, q, v, params):
    return 0.5 * (v["psi"] ** 2 + (jnp.sin(q["psi"]) * v["theta"]) ** 2)


def in_space(s, q, v, params):
    return 0.5 * jnp.sum(v**2)


sphere = lj.Holonomic(lambda s, q, params: jnp.sum(q**2) - params["R"] ** 2)
over_azimuth, chart = lj.System(length), lj.System(on_the_map)
embedded = lj.System(in_space, constraints={"sphere": sphere})
params = {"R": 1.0}  # all lengths in radii

# %% [markdown]
# ## Great circles in disguise
#
# (The solution that this notebook follows calls $\psi$ the azimuth and $\theta$ the polar angle; with $z = R\cos\psi$
# it is the other way round.) With $\theta$ as time the solutions must be $\cot\psi = A\cos\theta + B\sin\theta$,
# plane sections of the sphere. The solution adds "with $A^2 + B^2 < 1$". A sweep over the inclination $i$ of the
# plane:

# %%
theta = jnp.linspace(-jnp.pi, jnp.pi, 25)


def around(point):
    psi, slope = exact.exact_over_azimuth(point["A"], 0.0, theta[0])
    return lj.integrate(over_azimuth, psi, slope, params, ts=theta, rtol=1e-10, atol=1e-10)


inclinations = np.array([20.0, 40.0, 60.0, 80.0])
A = np.tan(np.radians(inclinations))
circles = lj.sweep(around, {"A": A}, progress=False).values
off = max(float(jnp.max(jnp.abs(q - exact.exact_over_azimuth(a, 0.0, theta)[0]))) for q, a in zip(circles.q, A))
fine = np.linspace(-np.pi, np.pi, 181)
fig, axes = plot.figure(size=(6.2, 3.2))
axis = axes[0, 0]
for i, (a, q) in enumerate(zip(A, circles.q)):
    words = f"{inclinations[i]:.0f}°, A² + B² = {a**2:.2g}"
    axis.plot(np.degrees(fine), np.degrees(exact.exact_over_azimuth(a, 0.0, fine)[0]), label=words, **plot.style(i))
    axis.plot(np.degrees(theta), np.degrees(q), plot.MARKERS[i], color=plot.COLOURS[i], markersize=3.5)
axis.set(
    xlabel=r"azimuth $\theta$ / degrees", ylabel=r"colatitude $\psi$ / degrees", title="Lines: planes. Marks: lagjax"
)
axis.set_xticks(range(-180, 181, 60))
axis.invert_yaxis()
axis.legend(fontsize=9, frameon=False, title="inclination", loc="center left", bbox_to_anchor=(1.0, 0.5))
fig

# %% [markdown]
# All solutions are great circles, also those with $A^2 + B^2 = \tan^2 i > 1$; the bound would forbid every inclination
# above 45°. The lines gather into a step as $i \to 90°$, and a meridian, $i = 90°$, is not a function of $\theta$ at
# all.
#
# The same solution prints the first line of Lagrange's equation as
# $\frac{\mathrm d}{\mathrm d\theta}\frac{\partial f}{\partial\psi'} - \frac{\partial f}{\partial\psi'}$; the last
# term is $\partial f/\partial\psi$. A great circle decides which is right:


# %%
def residuals(theta, a):
    psi, slope = exact.exact_over_azimuth(a, 0.0, theta)
    momentum = lambda theta: jax.grad(length, 2)(theta, *exact.exact_over_azimuth(a, 0.0, theta), params)
    rate = jax.grad(momentum)(theta)
    return {
        "right": rate - jax.grad(length, 1)(theta, psi, slope, params),
        "printed": rate - jax.grad(length, 2)(theta, psi, slope, params),
    }


worst = {name: float(jnp.max(jnp.abs(x))) for name, x in jax.vmap(residuals, (0, None))(theta, A[2]).items()}
print({name: f"{value:.1e}" for name, value in worst.items()})

# %% [markdown]
# ## Past the pole
#
# Follow a great circle that passes the pole at the small distance $\varepsilon$, from one radian before to one radian
# after. How many steps does each form take (at most 4096), and how large is the error at the end?


# %%
def ends(eps):
    """Colatitude, azimuth and their rates by arc length, one radian before and after the pole, and cot ε."""
    s = jnp.array([-1.0, 1.0])
    psi = jnp.arctan2(jnp.sqrt(jnp.sin(s) ** 2 + (jnp.cos(s) * jnp.sin(eps)) ** 2), jnp.cos(s) * jnp.cos(eps))
    azimuth = jnp.arctan2(jnp.sin(s), jnp.cos(s) * jnp.sin(eps))
    turning = jnp.sin(eps) / jnp.sin(psi) ** 2
    return psi, azimuth, jnp.cos(eps) * jnp.sin(s) / jnp.sin(psi), turning


tight = {"rtol": 1e-10, "atol": 1e-10}
span = jnp.array([0.0, 2.0])


def missed(psi, azimuth, point):
    at = ends(point["eps"])
    return jnp.linalg.norm(exact.cartesian(params, psi, azimuth) - exact.cartesian(params, at[0][1], at[1][1]))


def by_azimuth(point):
    psi, azimuth, rate, turning = ends(point["eps"])
    end = lj.integrate(over_azimuth, psi[0], rate[0] / turning[0], params, ts=azimuth, max_steps=4096, **tight).end
    return missed(end.q, end.t, point)


def by_chart(point):
    psi, azimuth, rate, turning = ends(point["eps"])
    start = {"psi": psi[0], "theta": azimuth[0]}, {"psi": rate[0], "theta": turning[0]}
    end = lj.integrate(chart, *start, params, ts=span, **tight).end
    return missed(end.q["psi"], end.q["theta"], point)


def by_space(point):
    psi, azimuth, rate, turning = ends(point["eps"])
    start = jax.jvp(lambda psi, theta: exact.cartesian(params, psi, theta), (psi[0], azimuth[0]), (rate[0], turning[0]))
    end = lj.integrate(embedded, *start, params, ts=span, **tight).end
    at = exact.cartesian(params, psi[1], azimuth[1])
    return jnp.linalg.norm(end.q - at)


distances = np.geomspace(1e-7, 0.3, 14)
forms = {"θ as time": by_azimuth, "ψ, θ": by_chart, "in space": by_space}
passes = {name: lj.sweep(form, {"eps": distances}, progress=False) for name, form in forms.items()}
fig, axes = plot.figure(1, 2, size=(4.3, 3.3))
left, right = axes[0]
for i, (name, swept) in enumerate(passes.items()):
    style = plot.style(i) | {"marker": plot.MARKERS[i], "markersize": 4, "label": name}
    left.loglog(distances, np.where(swept.ok, swept.status.steps, np.nan), **style)
    right.loglog(distances, np.maximum(swept.values, 1e-16), **style)
left.set(xlabel=r"distance from the pole $\varepsilon$ / R", ylabel="steps", title="Work")
right.set(
    xlabel=r"distance from the pole $\varepsilon$ / R", ylabel="misses its end by / R", title="Error, rtol = 1e-10"
)
left.legend(fontsize=9, frameon=False)
fig

# %% [markdown]
# With $\theta$ as time the whole passage happens in a short interval, and $\psi' = \mathrm d\psi/\mathrm d\theta$ is of
# the order of $1/\varepsilon$ before and after it: at $\varepsilon = 10^{-4}$ the end has lost six digits, and nearer
# to the pole the integration fails. With $\psi$ and $\theta$ as coordinates of the free particle $\theta$ jumps,
# $\dot\theta = \sin\varepsilon/\sin^2\psi$; the integration resolves this with more and more steps, as
# $\ln(1/\varepsilon)$. In space nothing special happens: it takes eight steps, since the pole is a point like any
# other.
#
# At the pole itself the first two have a singular mass matrix. They are refused with a message:

# %%
refused = {}
for name, system, q, v in (
    ("θ as time", over_azimuth, 0.0, 1.0),
    ("ψ, θ", chart, {"psi": 0.0, "theta": 0.0}, {"psi": 1.0, "theta": 0.0}),
):
    try:
        lj.accelerations(system, 0.0, q, v, params)
    except ValueError as error:
        refused[name] = str(error)
        print(f"{name}: {str(error).splitlines()[0]}")

# %% [markdown]
# ## In space the multiplier gives the curvature
#
# $\ddot{\mathbf r} = 2\lambda\,\mathbf r$ with $\lambda = -1/(2R^2)$ at unit speed: the sphere's pull on the
# particle. This motion goes once around, over both poles, along a meridian, for which $A$ and $B$ do not exist:

# %%
once = jnp.linspace(0.0, 2 * jnp.pi, 49)
meridian = jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0])
orbit = lj.integrate(embedded, *meridian, params, ts=once, **tight)
closes = float(jnp.linalg.norm(orbit.q[-1] - orbit.q[0]))
print(f"comes back to its start to {closes:.0e}; multiplier {orbit.multipliers['sphere'].mean():.12f}")

# %% [markdown]
# ## Stationary is not shortest
#
# The solution looks for "the path with minimum length", but Lagrange's equation gives any *stationary* one. Displace
# an arc of the angle $S$ sideways by $\epsilon\sin(\pi s/S)$: its length changes by
# $\frac{1}{4}S\,[(\pi/S)^2 - 1]\,\epsilon^2$, and beyond half a turn it becomes shorter. Past the antipode the length
# of a great circle is a saddle point.

# %%
amplitude = jnp.linspace(-0.5, 0.5, 41)
arcs = {"100°": np.radians(100.0), "180°": np.pi, "260°": np.radians(260.0)}
fig, axes = plot.figure(size=(5.4, 3.0))
axis, changes, curvature = axes[0, 0], {}, {}
for i, (name, angle) in enumerate(arcs.items()):
    longer = lambda x: exact.varied_length(angle, x) - angle
    changes[name] = jax.vmap(longer)(amplitude)
    curvature[name] = float(jax.grad(jax.grad(longer))(0.0)), float(exact.second_variation(angle))
    axis.plot(amplitude, changes[name], label=f"arc of {name}", **plot.style(i))
axis.set(xlabel="sideways displacement / R", ylabel="change of length / R", title="Shortest up to half a turn")
axis.legend(fontsize=9, frameon=False)
fig

# %%
assert off < 1e-8 and abs(A[2] ** 2 - 3) < 1e-12 and A[0] ** 2 < 1 < A[2] ** 2
clairaut = [jnp.sin(q) ** 2 / length(0.0, q, v, params) for q, v in zip(circles.q, circles.v)]
assert all(np.allclose(x, np.cos(np.radians(i)), rtol=1e-8) for x, i in zip(clairaut, inclinations))
assert worst["right"] < 1e-12 and worst["printed"] > 0.1
on_map, space = passes["ψ, θ"], passes["in space"]
assert on_map.ok.all() and space.ok.all() and max(on_map.values.max(), space.values.max()) < 1e-10
assert np.all(space.status.steps == 8) and np.all(np.diff(on_map.status.steps) < 0)
lost = passes["θ as time"]
assert not lost.ok[distances < 5e-5].any() and lost.ok[distances > 5e-5].all()
near = np.argmin(np.abs(np.log(distances / 1e-4)))
assert 1e-5 < lost.values[near] < 1e-3 and lost.values[-1] < 1e-9
assert len(refused) == 2 and all("mass matrix is singular" in words for words in refused.values())
assert closes < 1e-9 and np.allclose(orbit.multipliers["sphere"], exact.exact_multiplier(params), rtol=1e-9)
assert all(abs(measured - closed) < 1e-9 for measured, closed in curvature.values())
assert curvature["100°"][0] > 1 and curvature["260°"][0] < -1 and np.max(changes["260°"]) == 0
small = np.array([0.01, -0.01])
for angle in arcs.values():
    change = [float(exact.varied_length(angle, x)) - angle for x in small]
    assert np.allclose(change, 0.25 * angle * ((np.pi / angle) ** 2 - 1) * small**2, atol=1e-7)
