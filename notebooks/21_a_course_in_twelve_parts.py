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
# # A course in twelve short parts
#
# Can a course in mechanics be computed from its Lagrangians alone? Each part has a few sentences of physics, a
# Lagrangian, and one number that is also known in closed form. The `assert` says how well the two agree: change
# something, and it tells you whether your formula is still right.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from scipy.special import mathieu_a, mathieu_b

import lagjax as lj

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams.update({"savefig.dpi": 90, "figure.constrained_layout.use": True})  # small pictures

# %% [markdown]
# ## 1. The equations, written out
#
# A Lagrangian is a function of time, coordinates, velocities and parameters. Lagrange's equations follow from it by
# differentiation alone, here for a double pendulum of two equal masses on two equal rods. `lj.latex` writes them out,
# after comparing the formulas with what the program computes.


# %%
def double_pendulum(t, q, v, params):
    m, l, g = params["m"], params["l"], params["g"]
    together = v["alpha"] * v["beta"] * jnp.cos(q["alpha"] - q["beta"])
    kinetic = m * l**2 * (v["alpha"] ** 2 + 0.5 * v["beta"] ** 2 + together)
    return kinetic + m * g * l * (2 * jnp.cos(q["alpha"]) + jnp.cos(q["beta"]))


double = lj.System(double_pendulum)
params = {"m": 0.5, "l": 0.75, "g": 9.81}  # kg, m, m/s²
q, v = {"alpha": 0.3, "beta": 1.2}, {"alpha": 0.0, "beta": 0.0}
lj.latex(double, q, v, params)

# %% [markdown]
# At rest the two equations are easily solved by hand for $\ddot\alpha$, with $\delta = \alpha - \beta$:
#
# $$\ddot\alpha = \frac{g}{l}\,\frac{\cos\delta\,\sin\beta - 2\sin\alpha}{2 - \cos^2\delta}.$$

# %%
a, _ = lj.accelerations(double, 0.0, q, v, params)
delta = q["alpha"] - q["beta"]
by_hand = 9.81 / 0.75 * (np.cos(delta) * np.sin(q["beta"]) - 2 * np.sin(q["alpha"])) / (2 - np.cos(delta) ** 2)
print(f"by lagjax {a['alpha']:.12f} 1/s², by hand {by_hand:.12f} 1/s²")
assert abs(a["alpha"] / by_hand - 1) < 1e-12

# %% [markdown]
# ## 2. A symmetry and its charge
#
# Now the two rods float without weight, on a hinge. Nothing depends on their direction: to turn both is a symmetry,
# and Noether's theorem gives what it conserves, the angular momentum of both together. The rods pass it to each other.
# The second one starts alone, at the rate $\dot\beta$, and brings $m\,l^2\dot\beta\,(1 + \cos(\alpha - \beta))$.

# %%
floating = params | {"g": 0.0}
v0, ts = {"alpha": 0.0, "beta": 4.0}, jnp.linspace(0.0, 8.0, 401)
print(lj.symmetries(double, q, v0, floating))
traj = lj.integrate(double, q, v0, floating, ts=ts)
turn_both = lj.noether_charge(double, lambda t, q, params: {"alpha": 1.0, "beta": 1.0})
charge = jax.vmap(lambda t, q, v: turn_both(t, q, v, floating))(traj.t, traj.q, traj.v)
by_hand = 0.5 * 0.75**2 * 4.0 * (1 + np.cos(0.3 - 1.2))
print(f"at the end the charge is {charge[-1]:.10f} kg m²/s, in closed form {by_hand:.10f}")
np.testing.assert_allclose(charge, by_hand, rtol=1e-8)

# %%
momenta = jax.vmap(lambda q, v: lj.momentum(double, 0.0, q, v, floating))(traj.q, traj.v)
plt.figure(figsize=(6, 2.8))
plt.plot(ts, momenta["alpha"], label=r"$p_\alpha$")
plt.plot(ts, momenta["beta"], label=r"$p_\beta$")
plt.plot(ts, charge, "k--", label="together")
plt.xlabel("t, s")
plt.ylabel("momentum, kg m²/s")
plt.legend(ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
plt.show()

# %% [markdown]
# ## 3. Foucault's pendulum
#
# Seen from the Earth, which turns with $\Omega$, a long pendulum at the latitude $\varphi$ has the velocity
# $\dot{\mathbf r} + \mathbf\Omega\times\mathbf r$. Of $\mathbf\Omega$ only the vertical part $\Omega\sin\varphi$
# matters. The oval that it swings on stays fixed among the stars, so in Paris its plane turns backward, by
# $\Omega\sin\varphi$ times the time. After a whole number of swings the bob is at a turning point again, and shows it.


# %%
def foucault(t, q, v, params):
    x, y = q
    turn = params["Omega"] * jnp.sin(params["latitude"])
    return 0.5 * ((v[0] - turn * y) ** 2 + (v[1] + turn * x) ** 2) - 0.5 * params["g"] / params["l"] * (x**2 + y**2)


pantheon = lj.System(foucault)
params = {"g": 9.81, "l": 67.0, "latitude": np.radians(48.846), "Omega": 2 * np.pi / 86164.1}  # m/s², m, rad, rad/s
swing = 2 * np.pi * np.sqrt(params["l"] / params["g"])
ts = jnp.linspace(0.0, 220 * swing, 1401)  # an hour
traj = lj.integrate(pantheon, jnp.array([3.0, 0.0]), jnp.zeros(2), params, ts=ts)
turned = np.degrees(np.arctan2(traj.q[-1, 1], traj.q[-1, 0]))
by_hand = -np.degrees(params["Omega"] * np.sin(params["latitude"]) * ts[-1])
print(f"in {ts[-1] / 60:.1f} minutes the plane turns by {turned:.8f}°, in closed form {by_hand:.8f}°")
assert abs(turned - by_hand) < 1e-6

# %% [markdown]
# On an Earth whose day has only ten minutes one sees the rosette. The bob is released at rest: its curve has cusps.

# %%
ts = jnp.linspace(0.0, 14 * swing, 1401)
rosette = lj.integrate(pantheon, jnp.array([3.0, 0.0]), jnp.zeros(2), params | {"Omega": 2 * np.pi / 600}, ts=ts)
plt.figure(figsize=(3.6, 3.6))
plt.plot(rosette.q[:, 0], rosette.q[:, 1], lw=0.9)
plt.axis("equal")
plt.xlabel("x, m")
plt.ylabel("y, m")
plt.show()

# %% [markdown]
# ## 4. The perihelion of a relativistic planet
#
# A fast particle has the Lagrangian $-mc^2\sqrt{1 - v^2/c^2} + k/r$. Its ellipse does not close: Sommerfeld found that
# from one perihelion to the next the angle is $2\pi/\sqrt{1 - k^2/(c\,p_\varphi)^2}$. (For Mercury this is a sixth of
# Einstein's 43 seconds of arc a century. The rest is curved space.)


# %%
def planet(t, q, v, params):
    c, speed_squared = params["c"], v["r"] ** 2 + (q["r"] * v["phi"]) ** 2
    return -(c**2) * jnp.sqrt(1 - speed_squared / c**2) + params["k"] / q["r"]


sommerfeld = lj.System(planet)
params = {"c": 4.0, "k": 1.0}
q0, v0 = {"r": 1.0, "phi": 0.0}, {"r": 0.0, "phi": 1.25}
events = {"perihelion": lj.turning_points("r", direction=1)}
traj = lj.integrate(sommerfeld, q0, v0, params, ts=jnp.linspace(0.0, 150.0, 1501), events=events)
angles = traj.events["perihelion"].found().q["phi"]
p_phi = lj.momentum(sommerfeld, 0.0, q0, v0, params)["phi"]
by_hand = 2 * np.pi / np.sqrt(1 - (params["k"] / (params["c"] * p_phi)) ** 2)
print(f"a turn takes {np.degrees(angles[0]):.8f}°, in closed form {np.degrees(by_hand):.8f}°")
np.testing.assert_allclose(angles, by_hand * np.arange(1, 1 + len(angles)), rtol=1e-8)

# %%
plt.figure(figsize=(3.8, 3.6))
plt.plot(traj.q["r"] * jnp.cos(traj.q["phi"]), traj.q["r"] * jnp.sin(traj.q["phi"]), lw=0.9, label="orbit")
plt.plot(jnp.cos(angles), jnp.sin(angles), "k.", label="perihelia")
plt.plot(0.0, 0.0, "*", color="orange", ms=12)
plt.axis("equal")
plt.xlabel("x")
plt.ylabel("y")
plt.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## 5. A heavy top
#
# A top is held at an angle, and let go. Its axis falls, is turned aside, and comes back up to where it was: it nods
# while it goes round. How far it falls follows from energy and two momenta: with $u = \cos\theta$, $a = p_\psi/A$ and
# $\beta = 2mgl/A$, the lowest point is at $1 - u^2 = (a^2/\beta)\,(u_0 - u)$.


# %%
def top_lagrangian(t, q, v, params):
    A, C, u = params["A"], params["C"], jnp.cos(q["theta"])
    turning = A * (v["theta"] ** 2 + (v["phi"] * jnp.sin(q["theta"])) ** 2) + C * (v["psi"] + v["phi"] * u) ** 2
    return 0.5 * turning - params["mgl"] * u


top = lj.System(top_lagrangian)
params = {"A": 1.0, "C": 0.5, "mgl": 1.0}
q0, v0 = {"phi": 0.0, "theta": 0.6, "psi": 0.0}, {"phi": 0.0, "theta": 0.0, "psi": 6.0}
ts = jnp.linspace(0.0, 12.0, 4001)  # close enough to see the lowest point
traj = lj.integrate(top, q0, v0, params, ts=ts)
lowest = traj.q["theta"].max()
s, u0 = (params["C"] * v0["psi"] / params["A"]) ** 2 / (2 * params["mgl"] / params["A"]), np.cos(q0["theta"])
by_hand = np.arccos((s - np.sqrt(s**2 - 4 * (s * u0 - 1))) / 2)
print(f"it falls from {q0['theta']} to {lowest:.6f}, in closed form {by_hand:.6f}")
assert abs(lowest - by_hand) < 1e-5

# %% [markdown]
# The path of the axis has cusps where it was at rest. Given a push forward it draws waves, backward loops.

# %%
figure, axes = plt.subplots(1, 3, figsize=(7.5, 2.3), sharey=True)
for axis, push, name in zip(axes, (0.2, 0.0, -0.2), ("pushed forward", "let go", "pushed backward")):
    path = lj.integrate(top, q0, v0 | {"phi": push}, params, ts=ts).q
    axis.plot(path["phi"], path["theta"])
    axis.set(title=name, xlabel=r"$\varphi$")
axes[0].set_ylabel(r"$\theta$")
axes[0].invert_yaxis()
plt.show()

# %% [markdown]
# ## 6. The brachistochrone
#
# Which slide is the fastest? A bead at the depth $y$ has the speed $\sqrt{2gy}$, so that the time of a path is its
# length measured by $(\mathrm dx^2 + \mathrm dy^2)/2gy$, and the fastest path is a geodesic. Bernoulli found it: a
# point on the rim of a wheel of radius $R$ that rolls under the line $y = 0$, which takes the time $\sqrt{R/g}$ for
# each radian.


# %%
def slide(q, v, params):
    return (v["x"] ** 2 + v["y"] ** 2) / (2 * params["g"] * q["y"])


def wheel(angle, R=1.0):
    return {"x": R * (angle - np.sin(angle)), "y": R * (1 - np.cos(angle))}


first, last = wheel(0.5), wheel(4.0)  # the bead arrives at the first point as fast as if it had fallen from y = 0
fastest = lj.geodesic(slide, first, last, {"g": 9.81}, elements=16)
by_hand = (4.0 - 0.5) * np.sqrt(1.0 / 9.81)
print(f"it takes {fastest.length:.10f} s, in closed form {by_hand:.10f} s")
assert abs(fastest.length / by_hand - 1) < 1e-8

# %%
dx, dy = last["x"] - first["x"], last["y"] - first["y"]
straight = 2 * np.hypot(dx, dy) / (np.sqrt(2 * 9.81 * first["y"]) + np.sqrt(2 * 9.81 * last["y"]))
plt.figure(figsize=(5.5, 2.8))
plt.plot(*wheel(np.linspace(0.5, 4.0, 101)).values(), lw=4, color="0.8", label="cycloid")
plt.plot(fastest.connection.q["x"], fastest.connection.q["y"], label=f"geodesic: {fastest.length:.3f} s")
plt.plot([first["x"], last["x"]], [first["y"], last["y"]], "--", label=f"straight: {straight:.3f} s")
plt.gca().invert_yaxis()
plt.axis("equal")
plt.xlabel("x, m")
plt.ylabel("depth y, m")
plt.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## 7. How carbon dioxide swings
#
# Three masses in a line, O=C=O, with two equal springs. One mode is free: the molecule moves as a whole. In one the
# carbon rests and the oxygens breathe; in the other the carbon swings against both. The springs drop out of the ratio
# of the two frequencies, $\sqrt{1 + 2 m_O/m_C}$. (Measured are 2349 and 1333 wave numbers: real bonds also feel each
# other.)


# %%
def molecule(t, q, v, params):
    kinetic = 0.5 * (params["O"] * (v["left"] ** 2 + v["right"] ** 2) + params["C"] * v["C"] ** 2)
    stretched = jnp.array([q["C"] - q["left"], q["right"] - q["C"]]) - params["bond"]
    return kinetic - 0.5 * params["k"] * jnp.sum(stretched**2)


params = {"O": 15.995, "C": 12.0, "k": 1600.0, "bond": 1.16}  # atomic mass units, N/m, Å
rest = {"left": -1.16, "C": 0.0, "right": 1.16}
modes = lj.normal_modes(lj.System(molecule), 0.0, rest, dict.fromkeys(rest, 0.0), params)
modes

# %%
free, breathing, against = modes.frequency
by_hand = np.sqrt(1 + 2 * params["O"] / params["C"])
print(f"ratio {against / breathing:.12f}, in closed form {by_hand:.12f}; measured {2349 / 1333:.3f}")
assert abs(against / breathing / by_hand - 1) < 1e-12

# %%
modes[2].plot()

# %% [markdown]
# ## 8. Parametric resonance
#
# A child on a swing pumps by moving up and down: a parameter oscillates, and with twice the frequency of the swing.
# Mathieu's equation $\ddot x + (a - 2q\cos 2t)\,x = 0$ is the simplest such swing. Small motions grow where a Floquet
# multiplier lies outside the unit circle; on the borders of the tongues both are $\pm1$, so that their sum is $\pm2$.
# There $a$ is one of Mathieu's characteristic values, which SciPy knows.


# %%
def mathieu(t, q, v, params):
    return 0.5 * v**2 - 0.5 * (params["a"] - 2 * params["q"] * jnp.cos(2 * t)) * q**2


swing = lj.System(mathieu)


def multipliers(a, depth):
    return lj.floquet(swing, 0.0, 0.0, 0.0, {"a": a, "q": depth}, jnp.pi).multipliers


stiffness, depth = np.linspace(-0.5, 5.0, 45), np.linspace(0.0, 2.5, 26)
a = np.column_stack([np.tile(stiffness, (26, 1)), mathieu_a(1, depth)])  # the last column lies on a border
found = jax.jit(jax.vmap(jax.vmap(multipliers, (0, None))))(a, depth)
on_border = found[:, -1].sum(axis=-1)
print(f"on the border the sum of the multipliers is {on_border[10].real:.10f} at q = {depth[10]:g}")
np.testing.assert_allclose(on_border, -2.0, atol=1e-8)

# %%
largest = np.abs(found[:, :-1]).max(axis=-1)
plt.figure(figsize=(5.5, 3.2))
shown = plt.pcolormesh(stiffness, depth, np.log(largest) / np.pi, cmap="Oranges", shading="gouraud", vmin=0.0)
plt.colorbar(shown, label="growth, 1/[t]")
for order in range(3):
    plt.plot(mathieu_a(order, depth), depth, "k", lw=0.9, label="borders" if order == 0 else None)
    plt.plot(mathieu_b(order + 1, depth), depth, "k", lw=0.9)
plt.xlim(stiffness[0], stiffness[-1])
plt.xlabel("a")
plt.ylabel("q")
plt.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## 9. Chaos in a double pendulum
#
# Back in its weight, the double pendulum of part 1 goes wild. Two that start almost alike are soon far apart: their
# distance grows like $\mathrm e^{\lambda t}$, with Lyapunov's exponent $\lambda$. There are four exponents, one for
# each direction in the space of states. They can only be measured, but Liouville's theorem knows their sum: a volume
# of positions and momenta stays as large as it is. One of positions and velocities changes with the determinant of the
# mass matrix, $2 - \cos^2(\alpha - \beta)$ times a constant: it at most doubles. So over a time $T$ the sum is zero to
# $\ln 2/T$.

# %%
params = {"m": 0.5, "l": 0.75, "g": 9.81}  # kg, m, m/s²
start, rest, ts = {"alpha": 2.0, "beta": 2.5}, {"alpha": 0.0, "beta": 0.0}, jnp.linspace(0.0, 8.0, 401)
exponents = lj.lyapunov_exponents(double, start, rest, params, ts=jnp.linspace(0.0, 60.0, 121), count=4).exponents
bound = np.log(2) / 45.0  # the first quarter of the 60 s is not counted
print(f"exponents {exponents.round(2)} 1/s, their sum {exponents.sum():.3f} 1/s, in closed form 0 ± {bound:.3f} 1/s")
assert abs(exponents.sum()) < bound

# %%
pair = [start, start | {"alpha": 2.0 + 1e-8}]
one, other = (lj.integrate(double, q, rest, params, ts=ts, estimate_error=False).q for q in pair)
apart = jnp.hypot(one["alpha"] - other["alpha"], one["beta"] - other["beta"])
plt.figure(figsize=(6, 2.8))
plt.semilogy(ts, apart, label="distance of two motions")
plt.semilogy(ts, 1e-8 * np.exp(exponents[0] * ts), "k--", lw=0.9, label=r"$10^{-8}\,\mathrm{e}^{\lambda t}$")
plt.xlabel("t, s")
plt.ylabel("distance, rad")
plt.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## 10. Charges in crossed fields
#
# In a magnetic field $B$ along $z$ and an electric field $E$ along $y$ a charge at rest does not follow $E$. It draws
# a cycloid along $x$, and drifts with the speed $E/B$, whatever its charge and mass are. In one turn, $2\pi m/eB$, it
# comes $2\pi mE/eB^2$ far. The magnetic force comes from the term $e\,\mathbf A\cdot\mathbf v$, here with
# $\mathbf A = (-By, 0, 0)$.


# %%
def charge_in_fields(t, q, v, params):
    x, y = q
    kinetic = 0.5 * params["m"] * jnp.sum(v**2)
    return kinetic + params["e"] * (params["E"] * y - params["B"] * y * v[0])


charge = lj.System(charge_in_fields)
ts = jnp.linspace(0.0, 4 * np.pi, 241)


def path(m, e):
    return lj.integrate(charge, jnp.zeros(2), jnp.zeros(2), {"m": m, "e": e, "E": 0.5, "B": 1.0}, ts=ts).q


paths = {(m, e): path(m, e) for m, e in ((1.0, 1.0), (0.5, 1.0), (2.0, -1.0))}
ends = np.array([q[-1] for q in paths.values()])
by_hand = 0.5 / 1.0 * ts[-1]
print(f"after whole turns they are at x = {ends[:, 0]}, in closed form {by_hand:.8f}")
np.testing.assert_allclose(ends, [[by_hand, 0.0]] * 3, atol=1e-7)

# %%
plt.figure(figsize=(6, 2.8))
for (m, e), q in paths.items():
    plt.plot(q[:, 0], q[:, 1], label=f"m = {m:g}, e = {e:+g}")
plt.axis("equal")
plt.xlabel("x")
plt.ylabel("y")
plt.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
plt.show()

# %% [markdown]
# ## 11. Sliding friction
#
# A block is pushed up a slope of the angle $\alpha$. Going up, gravity and friction brake it together, and it stops
# after $v^2/2g\,(\sin\alpha + \mu\cos\alpha)$. Whether it comes back depends on the roughness alone: for
# $\mu > \tan\alpha$ it stays. `lj.Friction` slides, and sticks.


# %%
def slope(t, q, v, params):
    return 0.5 * v**2 - params["g"] * jnp.sin(params["alpha"]) * q


rough = lj.Friction(
    sliding=lambda t, q, v, params: v,
    coefficient=lambda params: params["mu"],
    normal=lambda t, q, v, params: params["g"] * jnp.cos(params["alpha"]),
)
block, params = lj.System(slope, elements={"slope": rough}), {"g": 9.81, "alpha": 0.4}  # m/s², rad; the mass is 1
ts = jnp.linspace(0.0, 1.5, 151)
places = {mu: lj.integrate(block, 0.0, 3.0, params | {"mu": mu}, ts=ts).q for mu in (0.0, 0.3, 0.6)}
by_hand = 3.0**2 / (2 * 9.81 * (np.sin(0.4) + 0.6 * np.cos(0.4)))
print(f"with μ = 0.6 it stays at {places[0.6][-1]:.10f} m, in closed form {by_hand:.10f} m; tan α = {np.tan(0.4):.3f}")
assert abs(places[0.6][-1] / by_hand - 1) < 1e-8

# %%
plt.figure(figsize=(6, 2.8))
for mu, x in places.items():
    plt.plot(ts, x, label=rf"$\mu$ = {mu:g}")
plt.xlabel("t, s")
plt.ylabel("place on the slope, m")
plt.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## 12. A constraint force that lets go
#
# A boy slides off a smooth dome of ice. Lagrange's multiplier is the force of the dome, which pushes and cannot pull:
# where it reaches zero he flies. With a push $v$ at the top this is at $\cos\theta = 2/3 + v^2/3gR$.


# %%
def boy(t, q, v, params):
    return 0.5 * jnp.sum(v**2) - params["g"] * q[1]


dome = lj.System(boy, {"ice": lj.Holonomic(lambda t, q, params: jnp.sqrt(jnp.sum(q**2)) - params["R"])})
no_force = lj.Crossing(lambda t, q, v, multipliers, params: multipliers["ice"])
g, R, push = 9.81, 2.0, 0.8  # m/s², m, m/s; the mass is 1
q0, v0, ts = jnp.array([0.0, R]), jnp.array([push, 0.0]), jnp.linspace(0.0, 1.2, 121)
traj = lj.integrate(dome, q0, v0, {"g": g, "R": R}, ts=ts, events={"leaves": no_force})
leaves, by_hand = traj.end.q[1] / R, 2 / 3 + push**2 / (3 * g * R)
print(f"he leaves at cos θ = {leaves:.10f}, in closed form {by_hand:.10f}")
assert abs(leaves / by_hand - 1) < 1e-8

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.2, 2.8))
angle, later = np.linspace(0.0, np.pi / 2, 91), np.linspace(0.0, 0.3, 31)
(x, y), (x_rate, y_rate) = traj.end.q, traj.end.v
left.fill_between(R * np.sin(angle), R * np.cos(angle), color="0.9")
left.plot(traj.q[:, 0], traj.q[:, 1], label="slides")
left.plot(x + x_rate * later, y + y_rate * later - g / 2 * later**2, "--", label="flies")
left.set(xlabel="x, m", ylabel="y, m", aspect="equal", ylim=(0.0, 2.2))
left.legend(fontsize=8, loc="lower left")
right.plot(traj.t, traj.multipliers["ice"])
right.plot(traj.end.t, 0.0, "k.", label="leaves")
right.set(xlabel="t, s", ylabel="force of the ice, N")
right.legend(fontsize=8)
plt.show()
