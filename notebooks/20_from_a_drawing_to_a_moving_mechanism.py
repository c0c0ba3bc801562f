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
# # From a drawing to a moving mechanism
#
# A pump: a motor turns a crank whose bearing is mounted *askew*, a rod leads from the crank's pin to a piston on
# a rail. The drawing is rough. Does the mechanism close, how does it run, what must its pin carry, and how long has the
# crank to be for a stroke of half a metre?

# %%
import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from scipy.integrate import simpson
from scipy.optimize import brentq

import lagjax as lj

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures

# %% [markdown]
# ## Parts and joints
#
# Two bodies. The bearing is a hinge, the pin a universal joint, and the rail two equations by hand: the end of the rod
# has the rail's y and z. Lengths are functions of `params`: they can be changed later without compiling again.

# %%
AXIS = np.array([0.0, -1.0, 0.5]) / np.sqrt(1.25)  # of the bearing, in space
crank = lj.bodies.Body("crank", mass=2.0, inertia=(0.02, 0.02, 0.04))
rod = lj.bodies.Body("rod", mass=1.0, inertia=(0.001, 0.05, 0.05))


def pin(params):
    return jnp.array([params["crank"], 0.0, 0.0])


def piston(params):
    return jnp.array([params["rod"] / 2, 0.0, 0.0])


def off_rail(t, q, params):
    return rod.point(q, piston(params))[1:] - jnp.array([0.0, params["rail"]])


def resistance(t, q, v, params):
    return -params["c"] * rod.velocity(q, v, piston(params))


joints = {
    "bearing": lj.bodies.revolute(lj.bodies.ground.at(axis=AXIS), crank.at()),
    "pin": lj.bodies.universal(crank.at(pin), rod.at(lambda params: -piston(params), axis=(0.0, 1.0, 0.0))),
    "rail": lj.Holonomic(off_rail),
}
loads = [
    lj.bodies.motor(lj.bodies.ground.at(axis=AXIS), crank.at(), lambda t, q, v, params: params["torque"]),
    lj.bodies.applied(rod.at(piston), resistance),
    lj.bodies.weight([crank, rod]),
]
pump = lj.bodies.multibody([crank, rod], joints, loads)
params = {"crank": 0.2, "rod": 0.6, "rail": 0.1, "torque": 3.0, "c": 12.0}

# %% [markdown]
# ## A rough drawing
#
# The rod was drawn somewhere near the pin. `lj.draw` shows it, with each body's axes (x red, y green, z blue), the axes of
# joints in black, and a magenta line where the pin is open. `lj.constraint_residual` says by how much each joint is open,
# `lj.consistent_state` finds the nearest state that the joints allow, here with the crank and its speed as drawn.

# %%
TILT = np.arctan2(1.0, 0.5)  # turns the z axis into AXIS
drawn = {
    "crank": lj.bodies.Pose.at(axis=(1.0, 0.0, 0.0), angle=TILT),
    "rod": lj.bodies.Pose.at((0.45, 0.03, -0.04), axis=(1.0, 0.05, 0.1), angle=TILT),
}
moving = {"crank": drawn["crank"].moving(spin=3.0 * AXIS), "rod": drawn["rod"].moving()}
lj.draw(pump, drawn, params, frames=True).figure()

# %%
for name, open_by in lj.constraint_residual(pump, 0.0, drawn, moving, params).items():
    print(f"{name:16} {np.abs(open_by).max():.3f}")

# %%
q0, v0 = lj.consistent_state(pump, 0.0, drawn, moving, params, hold="crank")
closed = lj.constraint_residual(pump, 0.0, q0, v0, params)
print("open by", max(float(jnp.abs(x).max()) for x in closed.values()))
print("the rod's middle", q0["rod"].position.round(6))
assert not lj.draw(pump, q0, params).apart()

# %% [markdown]
# With the rail 70 cm up and a rod of 60 cm it cannot close, and the message says by how much each joint stays open.

# %%
try:
    lj.consistent_state(pump, 0.0, drawn, moving, params | {"rail": 0.7}, hold="crank")
except ValueError as error:
    print(str(error).split("at the best state reached, ")[1])

# %% [markdown]
# ## It runs
#
# The motor pushes with a constant torque, the piston against a resistance that grows with its speed. Events are the
# dead centres, where the piston turns back.

# %%
dead_centre = lj.Crossing(lambda t, q, v, params: rod.velocity(q, v, piston(params))[0], terminal=False, most=48)
ts = jnp.linspace(0.0, 4.0, 401)


def run(params):
    q, v = lj.consistent_state(pump, 0.0, q0, v0, params, hold="crank")
    return lj.integrate(pump, q, v, params, ts=ts, events={"dead": dead_centre}, estimate_error=False)


traj = run(params)
print(traj)

# %%
speed = jax.vmap(crank.spin)(traj.q, traj.v) @ AXIS
place = jax.vmap(lambda q: rod.point(q, piston(params)))(traj.q)
figure, (above, below) = plt.subplots(2, 1, figsize=(6, 4), sharex=True)
above.plot(ts, speed)
above.set_ylabel("speed of the crank, 1/s")
below.plot(ts, place[:, 0])
dead = traj.events["dead"]
below.plot(dead.t, jax.vmap(lambda q: rod.point(q, piston(params))[0])(dead.q), "k.")
below.set(xlabel="t, s", ylabel="place of the piston, m")
figure.tight_layout()

# %% [markdown]
# ## What the pin must carry
#
# The first three multipliers of a joint whose points meet are the force on its second body, along the axes of space.
# Newton's law for the rod, over the whole run, is the check: what pin, rail, weight and resistance have pushed is what
# its momentum has changed by.

# %%
force = np.asarray(traj.multipliers["pin"][:, :3])
of_rail = np.pad(np.asarray(traj.multipliers["rail"]), ((0, 0), (1, 0)))
pushed = jax.vmap(lambda q, v: resistance(0.0, q, v, params))(traj.q, traj.v)
weight = np.array([0.0, 0.0, -9.81])
gained = np.asarray(traj.v["rod"].position[-1] - traj.v["rod"].position[0])
given = simpson(force + of_rail + np.asarray(pushed) + weight, x=np.asarray(ts), axis=0)
print("momentum gained", gained.round(6), " given", given.round(6))

# %%
plt.figure(figsize=(6, 3))
for i, name in enumerate("xyz"):
    plt.plot(ts, force[:, i], label=f"along {name}")
plt.plot(ts, np.linalg.norm(force, axis=1), "k", lw=0.8, label="in all")
plt.xlabel("t, s")
plt.ylabel("force of the pin on the rod, N")
plt.legend(fontsize=8, ncols=4, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
plt.tight_layout()

# %% [markdown]
# ## A length for a wanted stroke
#
# `run` was compiled for any lengths. The stroke is the way between two dead centres, and the crank that makes it half a
# metre the root of an equation in one unknown.


# %%
def stroke(length):
    fitted = params | {"crank": length}
    dead = run(fitted).events["dead"]
    ends = jax.vmap(lambda q: rod.point(q, piston(fitted))[0])(dead.q)
    return float(jnp.abs(ends[2] - ends[1]))


lengths = np.linspace(0.12, 0.3, 7)
strokes = [stroke(length) for length in lengths]
wanted = brentq(lambda length: stroke(length) - 0.5, 0.2, 0.3, xtol=1e-10)
print(f"a crank of {wanted:.6f} m has a stroke of {stroke(wanted):.6f} m")

# %% [markdown]
# Straight geometry says the same: the pin goes round on a tilted circle, and the piston sits where the rod reaches the
# rail.


# %%
def stroke_of_a_circle(length):
    angle = np.linspace(0.0, 2 * np.pi, 200_001)
    x, y, z = length * np.stack([np.cos(angle), AXIS[2] * np.sin(angle), -AXIS[1] * np.sin(angle)])
    return np.ptp(x + np.sqrt(params["rod"] ** 2 - y**2 - (z - params["rail"]) ** 2))


plt.figure(figsize=(6, 3))
plt.plot(lengths, [stroke_of_a_circle(length) for length in lengths], label="geometry")
plt.plot(lengths, strokes, "o", label="dead centres of motions")
plt.plot(wanted, 0.5, "k*", ms=10, label="wanted")
plt.xlabel("length of the crank, m")
plt.ylabel("stroke, m")
plt.legend()
plt.tight_layout()

# %% [markdown]
# ## In space
#
# The fitted pump: a system of bodies draws itself with `turning.draw()`, and with shapes as they look. The same shapes
# make a film that can be turned: `turning.animate(shapes)`.

# %%
turning = run(params | {"crank": wanted})
shapes = [
    lj.shapes.disk(crank, radius=0.06),
    lj.shapes.rod(crank, crank.at(pin), radius=0.012),
    lj.shapes.rod(rod.at(lambda params: -piston(params)), rod.at(piston), radius=0.008),
    lj.shapes.sphere(rod.at(piston), radius=0.03),
    lj.shapes.line((0.2, 0.0, params["rail"]), (0.95, 0.0, params["rail"])),
    lj.shapes.trail(crank.at(pin)),
    lj.shapes.trail(rod),
]
turning.draw(shapes, times=[0.0, 0.15, 0.3])

# %%
turning.animate(shapes)

# %% [markdown]
# What the text says, checked:

# %%
assert max(float(jnp.abs(x).max()) for x in closed.values()) < 1e-12
np.testing.assert_allclose(given, gained, atol=1e-4)
np.testing.assert_allclose(strokes, [stroke_of_a_circle(length) for length in lengths], atol=1e-7)
np.testing.assert_allclose(stroke_of_a_circle(wanted), 0.5, atol=1e-7)
