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
# # The engineer's arm
#
# A robot arm comes as a URDF file. What torques hold it, how well does a controller at 1 kHz make it follow a plan,
# and what do its links really weigh?

# %%
from dataclasses import replace

import jax
import jax.numpy as jnp
import matplotlib
import matplotlib.pyplot as plt
import numpy as np

import lagjax as lj

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams.update({"savefig.dpi": 90, "figure.constrained_layout.use": True})  # small pictures

URDF = """<robot name="arm">
  <link name="base"/>
  <link name="column">
    <inertial><origin xyz="0 0 0.15"/><mass value="4"/>
      <inertia ixx="0.04" iyy="0.04" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0 0 0.15"/><geometry><cylinder radius="0.06" length="0.3"/></geometry></visual>
  </link>
  <link name="upper">
    <inertial><origin xyz="0.2 0 0"/><mass value="2"/>
      <inertia ixx="0.003" iyy="0.03" izz="0.03" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.07 0.07"/></geometry></visual>
  </link>
  <link name="fore">
    <inertial><origin xyz="0.15 0 0"/><mass value="1"/>
      <inertia ixx="0.001" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0.15 0 0"/><geometry><box size="0.3 0.05 0.05"/></geometry></visual>
  </link>
  <joint name="waist" type="continuous">
    <parent link="base"/><child link="column"/><axis xyz="0 0 1"/><dynamics damping="0.2"/>
  </joint>
  <joint name="shoulder" type="continuous">
    <parent link="column"/><child link="upper"/><origin xyz="0 0 0.3"/><axis xyz="0 -1 0"/><dynamics damping="0.2"/>
  </joint>
  <joint name="elbow" type="continuous">
    <parent link="upper"/><child link="fore"/><origin xyz="0.4 0 0"/><axis xyz="0 -1 0"/><dynamics damping="0.2"/>
  </joint>
</robot>"""

model = lj.read_urdf(URDF)
arm, names = model.joint_system(), ["waist", "shoulder", "elbow"]
print(model)
model.draw({"waist": 0.4, "shoulder": 0.6, "elbow": -1.0}).figure()

# %% [markdown]
# ## Torques that hold it
#
# `lj.inverse_dynamics` says which torques give the joints wanted accelerations. At rest, with none, they are what
# holds the arm against gravity. The shoulder carries both links, the elbow one: with the angles $s$ and $e$,
# $\tau_e = m_2 g\,c_2\cos(s + e)$ and $\tau_s = \tau_e + (m_1 c_1 + m_2 l_1)\,g\cos s$. The waist is vertical and
# carries nothing.


# %%
@jax.jit
def torques(q, v, a):
    force, _ = lj.inverse_dynamics(arm, 0.0, *({n: x[i] for i, n in enumerate(names)} for x in (q, v, a)), None)
    return jnp.stack([force[name] for name in names])


pose, still = jnp.array([0.4, 0.6, -1.0]), jnp.zeros(3)
hold = torques(pose, still, still)
of_elbow = 1.0 * 9.81 * 0.15 * np.cos(0.6 - 1.0)
by_hand = [0.0, of_elbow + (2.0 * 0.2 + 1.0 * 0.4) * 9.81 * np.cos(0.6), of_elbow]
print("held by", hold.round(6), "N m; by hand", np.round(by_hand, 6))
np.testing.assert_allclose(hold, by_hand, atol=1e-12)

# %% [markdown]
# MuJoCo's `mj_inverse` computes the same, with velocities, accelerations and the dampers of the joints, where it is
# installed.

# %%
try:
    import mujoco
except ImportError:
    print("MuJoCo is not installed: nothing to compare with")
else:
    theirs = mujoco.MjModel.from_xml_string(URDF)
    data = mujoco.MjData(theirs)
    worst = 0.0
    for q, v, a in np.random.default_rng(0).normal(size=(20, 3, 3)):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(theirs, data)
        worst = max(worst, np.abs(torques(q, v, a) - data.qfrc_inverse).max())
    print("at 20 random states the two differ by less than 1e-12:", worst < 1e-12)
    assert worst < 1e-12

# %% [markdown]
# ## A controller at 1 kHz
#
# The plan leads smoothly from one pose to another in 0.4 s. The computer reads the joints a thousand times a second,
# adds the torques of the plan to those of a spring and a damper toward it, and holds its output until the next time:
# `lj.SampledControl`. The arm between two instants is integrated as exactly as ever.

# %%
START, GOAL, DURATION = jnp.array([0.0, -0.5, 1.2]), jnp.array([1.2, 0.7, -0.4]), 0.4


def plan(t):
    s = jnp.clip(t / DURATION, 0.0, 1.0)
    return START + (GOAL - START) * s**3 * (10 - 15 * s + 6 * s**2)


def controller(t, q, v, params):
    rate = jax.jacfwd(plan)
    now, speed = (jnp.stack([x[name] for name in names]) for x in (q, v))
    planned = torques(plan(t), rate(t), jax.jacfwd(rate)(t))
    return params["model"] * planned + params["kp"] * (plan(t) - now) + params["kd"] * (rate(t) - speed)


def motors(t, q, v, params):
    return {name: q["u"][i] for i, name in enumerate(names)} | {"u": jnp.zeros(3)}


control = lj.SampledControl(controller, every=1e-3)
driven = model.joint_system(force=motors, elements={"u": control})
ts = jnp.linspace(0.0, 0.5, 101)


def run(model):
    q0 = {name: START[i] for i, name in enumerate(names)} | {"u": jnp.zeros(3)}
    gains = {"model": model, "kp": jnp.array([200.0, 200.0, 80.0]), "kd": jnp.array([20.0, 20.0, 4.0])}
    return lj.integrate(driven, q0, dict.fromkeys(names, 0.0), gains, ts=ts, estimate_error=False)


with_model, without = run(1.0), run(0.0)
planned = jax.vmap(plan)(ts)
errors = {
    name: [jnp.abs(x.q[name] - planned[:, i]).max() for x in (with_model, without)] for i, name in enumerate(names)
}
for name, (small, large) in errors.items():
    print(f"{name:9} off by at most {small:.1e} rad with the model's torques, {large:.1e} rad without")
    assert small < 1e-3 < large

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(7.5, 2.8))
for i, name in enumerate(names):
    left.plot(ts, without.q[name], color=f"C{i}", label=name)
    left.plot(ts, planned[:, i], "--", color=f"C{i}", lw=0.9)
    right.plot(ts, with_model.q["u"][:, i], color=f"C{i}", label=name)
left.set(xlabel="t, s", ylabel="angle, rad", title="spring and damper alone; dashed: the plan")
right.set(xlabel="t, s", ylabel="torque, N m", title="with the model's torques")
right.legend(fontsize=8)
plt.show()

# %% [markdown]
# ## What the links weigh
#
# The masses in the file are those of a drawing. The same arm is built once more with masses that are parameters, its
# motors are given known torques, and its joints are recorded with an error of $10^{-4}$ rad. `lj.fit` finds the masses
# from the motion: those of the upper arm and the forearm. The column only turns about itself, so that its mass moves
# nothing, and no measurement of joints tells it.

# %%
bodies = {name: lj.bodies.Body(name, lambda params, name=name: params[name], body.inertia)
          for name, body in model.bodies.items()}  # fmt: skip


def weighed(place):
    """The same place of a joint, on the body whose mass is a parameter (the base is the ground)."""
    return replace(place, body=bodies.get(getattr(place.body, "name", ""), place.body))


def shaken(t, q, v, params):
    pull = {"waist": 4.0 * jnp.sin(7.0 * t), "shoulder": 9.0 + 3.0 * jnp.sin(5.0 * t), "elbow": 1.5 * jnp.cos(8.0 * t)}
    return {name: pull[name] - 0.2 * v[name] for name in names}


joints = {name: lj.bodies.revolute(*map(weighed, model.markers(name))) for name in names}
bench = lj.bodies.Tree(list(bodies.values()), joints).system([lj.bodies.weight(bodies.values())], force=shaken)
true, ts = {"column": 4.0, "upper": 2.3, "fore": 0.8}, jnp.linspace(0.0, 1.2, 61)
q0, v0 = {"waist": 0.0, "shoulder": -0.5, "elbow": 0.3}, dict.fromkeys(names, 0.0)
measured = lj.integrate(bench, q0, v0, true, ts=ts)
noise = np.random.default_rng(1).normal(scale=1e-4, size=(3, 61))
angles = {name: measured.q[name] + noise[i] for i, name in enumerate(names)}
record = lj.Record(ts, q=angles, sigma=1e-4)
drawn = {name: body.mass for name, body in model.bodies.items()}
found = lj.fit(bench, record, drawn, free=["upper", "fore"], progress=False)
found

# %%
fitted = {name: float(found.params[name]) for name in true}
again = lj.integrate(bench, q0, v0, fitted, ts=ts)
from_file = lj.integrate(bench, q0, v0, drawn, ts=ts)
plt.figure(figsize=(6, 2.8))
for i, name in enumerate(names):
    plt.plot(ts, angles[name], ".", ms=4, color=f"C{i}", label=f"{name}, recorded")
    plt.plot(ts, again.q[name], color=f"C{i}")
    plt.plot(ts, from_file.q[name], ":", color=f"C{i}")
plt.xlabel("t, s")
plt.ylabel("angle, rad")
plt.title("lines: fitted; dotted: masses of the file")
plt.legend(fontsize=8)
plt.show()

# %%
for name in ("upper", "fore"):
    print(f"{name}: {fitted[name]:.4f} kg, true {true[name]} kg, in the file {drawn[name]} kg")
    assert abs(fitted[name] / true[name] - 1) < 5e-3
