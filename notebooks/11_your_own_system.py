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
# # Your own system: a checklist
#
# How do you know that your system is the one you meant? The example is a ladder that slides down a wall. Each step
# below checks one more thing; the end shows what error messages look like and what they ask for.

# %%
import warnings

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

import lagjax as lj

jax.config.update("jax_enable_x64", True)  # before the first array


def lagrangian(t, q, v, params):
    m, l, g = params["m"], params["l"], params["g"]  # l: half of the ladder
    kinetic = 0.5 * m * (v["x"] ** 2 + v["y"] ** 2) + m * l**2 / 6 * v["angle"] ** 2
    return kinetic - m * g * q["y"]


wall = lj.Holonomic(lambda t, q, params: q["x"] - params["l"] * jnp.cos(q["angle"]))
floor = lj.Holonomic(lambda t, q, params: q["y"] - params["l"] * jnp.sin(q["angle"]))
ladder = lj.System(lagrangian, {"wall": wall, "floor": floor})
params = {"m": 10.0, "l": 2.5, "g": 9.81}

# %% [markdown]
# ## 1. Is it the system that I meant?
#
# `explain` counts degrees of freedom and analyses the mass matrix. A ladder on a wall and a floor has one degree of
# freedom; two would mean that a constraint is missing, none that there is one too many.

# %%
q0, v0 = {"x": 0.9, "y": 2.3, "angle": 1.2}, {"x": 0.0, "y": 0.0, "angle": 0.0}
explained = lj.explain(ladder, 0.0, q0, v0, params)
explained

# %% [markdown]
# ## 2. A start that satisfies the constraints
#
# The centre above is a guess: `explain` says by how much it violates the constraints. If the angle is held, the nearest
# state that satisfies the constraints is unique.

# %%
q0, v0 = lj.consistent_state(ladder, 0.0, q0, v0, params, hold="angle")
print({name: round(float(x), 6) for name, x in q0.items()})
a, forces = lj.accelerations(ladder, 0.0, q0, v0, params)
print(f"angular acceleration {a['angle']:.6f}, by hand {-0.75 * 9.81 / 2.5 * np.cos(1.2):.6f}")

# %% [markdown]
# ## 3. Integrate, and look at the reported accuracy
#
# The residual shows whether the constraints were satisfied; the change of the Jacobi integral (here the energy, because
# nothing depends on time) shows whether the motion is accurate. Both are relative, and both are at round-off here.

# %%
ts = jnp.linspace(0.0, 1.2, 61)
traj = lj.integrate(ladder, q0, v0, params, ts=ts)
traj

# %%
traj.plot()

# %% [markdown]
# You notice a wrong sign sooner in an animation than in a table.

# %%
traj.animate(
    lambda t, q, params: {
        "ladder": [(0.0, 2 * params["l"] * np.sin(q["angle"])), (2 * params["l"] * np.cos(q["angle"]), 0.0)],
        "centre": (q["x"], q["y"]),
    },
    seconds=3.0,
)

# %% [markdown]
# ## 4. Compare with other coordinates
#
# The angle alone describes the ladder too. Only the numbers were copied from the first description, so a mistake in
# either one shows.


# %%
def by_its_angle(t, q, v, params):
    m, l, g = params["m"], params["l"], params["g"]
    return 2 / 3 * m * l**2 * v**2 - m * g * l * jnp.sin(q)


one_angle = lj.System(by_its_angle)
other = lj.integrate(one_angle, 1.2, 0.0, params, ts=ts)
apart = float(jnp.max(jnp.abs(other.q - traj.q["angle"])))
print(f"the two differ by {apart:.1e}")

# %% [markdown]
# ## 5. Halve the tolerance
#
# The change is about the error of the first answer. Each output is the end of a step: 61 outputs would hide how long
# the steps may be, so this requests only the last one. The default method is too accurate to show anything in such a
# short fall, so this uses a method of order 5.


# %%
def angle_at_the_end(g, tolerance=1e-9, method=None):
    tight = {"rtol": tolerance, "atol": tolerance, "method": method}
    return lj.integrate(one_angle, 1.2, 0.0, params | {"g": g}, ts=jnp.array([0.0, 1.2]), **tight).q[-1]


best = angle_at_the_end(9.81, 1e-12)
halved = []
for tolerance in (1e-4, 1e-6, 1e-8):
    first, second = (angle_at_the_end(9.81, x, lj.Tsit5()) for x in (tolerance, tolerance / 2))
    halved.append((abs(second - first), abs(first - best)))
    print(f"{tolerance:.0e}: halved it changes by {halved[-1][0]:.1e}; the error was {halved[-1][1]:.1e}")

# %% [markdown]
# A step can jump over anything narrower than itself, whatever the tolerance: a push of a tenth of a second within a
# hundred, or a thin barrier. `max_step=` is the longest step (no step is longer than the time between two outputs
# either), and `jump_ts=` gives the times at which a force is switched. If there may be something narrow, compare with a
# `max_step` of its width.

# %% [markdown]
# ## 6. Compare a gradient with a finite difference
#
# Differentiate the final angle with respect to gravity. A difference of two motions keeps about half of the digits.
# (With constraints you request the gradient in the same way, and it takes longer to compile.)

# %%
gradient = jax.jacfwd(angle_at_the_end)(9.81)
step = 1e-3
difference = (angle_at_the_end(9.81 + step) - angle_at_the_end(9.81 - step)) / (2 * step)
print(f"gradient {gradient:.9f}, difference {difference:.9f}")

# %% [markdown]
# ## 7. Check a number known by hand
#
# Every system has a number that can be worked out on paper. The wall can only push, and its multiplier is its force:
# when it vanishes the ladder leaves the wall, which happens when its top has come down by a third. After that the
# constraint pulls, which a wall cannot do.

# %%
force = np.asarray(traj.multipliers["wall"])
last = np.flatnonzero(force > 0)[-1]
part = slice(last - 1, last + 3)
height = np.asarray(traj.q["y"] / traj.q["y"][0])
leaves_at = np.polyval(np.polyfit(force[part], height[part], 3), 0.0)
print(f"the wall is left at {leaves_at:.6f} of the first height")

# %% [markdown]
# ## 8. Mistakes that only you can see
#
# $L = T + V$ instead of $T - V$ is a Lagrangian too: that of a ladder that falls upwards. Its Jacobi integral is as
# constant as the right one, so the printed result does not show the mistake. A sign known by hand does: released from
# rest, everything moves to where V is lower.


# %%
def by_its_angle_with_the_wrong_sign(t, q, v, params):
    m, l, g = params["m"], params["l"], params["g"]
    return 2 / 3 * m * l**2 * v**2 + m * g * l * jnp.sin(q)


upwards = lj.System(by_its_angle_with_the_wrong_sign)
of_rest = lambda system: lj.accelerations(system, 0.0, 1.2, 0.0, params)[0]
climbed = lj.integrate(upwards, 1.2, 0.0, params, ts=ts)
print(f"angular acceleration at rest: {of_rest(one_angle):.3f} with T - V, {of_rest(upwards):+.3f} with T + V")
print(f"change of the Jacobi integral with T + V: {climbed.drift():.0e}")

# %% [markdown]
# Angles are in radians. 60.0, meant in degrees, is nine and a half turns: this gives an ordinary motion in the wrong
# place. A position known by hand shows it (here the height of the centre at the start), or the animation. `explain`
# reports angles of more than a full turn.

# %%
by_hand = 2.5 * np.sqrt(3) / 2
for start in (60.0, np.radians(60.0)):
    print(f"angle {start:.4g}: the centre is at {params['l'] * np.sin(start):+.3f}, by hand at {by_hand:+.3f}")

# %% [markdown]
# If you give a force instead of Rayleigh's function R, whose force is $-\partial R / \partial v$, lagjax notices: no
# dissipation function changes its sign with the velocity.

# %%
dragged = lj.System(by_its_angle, dissipation=lambda t, q, v, params: -3.0 * v)
with warnings.catch_warnings(record=True) as told:
    warnings.simplefilter("always")
    lj.integrate(dragged, 1.2, 0.0, params, ts=ts)
print(told[0].message)

# %% [markdown]
# ## What errors look like
#
# Each message says what happened, the usual cause, and the fix. These are the most common ones.


# %%
def says(act):
    try:
        act()
    except Exception as error:
        print(f"{type(error).__name__}: {error}\n")


def move(system=ladder, q0=q0, v0=v0, params=params, ts=ts, **options):
    return lj.integrate(system, q0, v0, params, ts=ts, **options)


says(lambda: move(system=lagrangian))
says(lambda: lj.integrate(ladder, q0, v0, params, ts))
says(lambda: move(v0={"x": 0.0, "y": 0.0, "theta": 0.0}))
says(lambda: move(params={"m": 10.0, "length": 2.5, "g": 9.81}))
says(lambda: move(ts=1.2))
says(lambda: move(method=diffrax.Dopri5))


# %% [markdown]
# Mistakes in the functions: NumPy, which has no derivatives; an `if`; arguments in the wrong order; an equation instead
# of its residual.


# %%
def by_numpy(t, q, v, params):
    return 0.5 * v**2 + params["g"] * np.cos(q)


def by_cases(t, q, v, params):
    if q > 0:
        return 0.5 * v**2
    return 0.5 * v**2 - params["k"] * q**2 / 2


says(lambda: move(lj.System(by_numpy), 1.0, 0.0))
says(lambda: move(lj.System(by_cases), 1.0, 0.0, {"k": 1.0}))
says(lambda: move(lj.System(lambda q, v, t, params: 0.5 * v**2), 1.0, 0.0))
says(lambda: move(lj.System(lagrangian, {"floor": lj.Holonomic(lambda t, q, params: q["y"] == 0.0)})))

# %% [markdown]
# Mistakes in the mechanics: a start that violates the constraints, a coordinate without kinetic energy, two constraints
# that contradict each other.

# %%
late = lj.Holonomic(lambda t, q, params: q["x"] - params["l"] * jnp.cos(q["angle"]) - 0.1 * t**2)
massless = lj.System(lambda t, q, v, params: 0.5 * v["a"] ** 2 - q["b"] ** 2)
says(lambda: move(v0=v0 | {"x": 1.0}))
says(lambda: lj.accelerations(massless, 0.0, {"a": 1.0, "b": 0.5}, {"a": 0.0, "b": 0.0}, None))
says(lambda: lj.accelerations(lj.System(lagrangian, {"wall": wall, "late": late}), 0.0, q0, v0, params))

# %% [markdown]
# A tolerance below the precision of the numbers: without `jax_enable_x64` everything is in single precision.

# %%
single = lambda tree: jax.tree.map(np.float32, tree)
says(lambda: move(q0=single(q0), v0=single(v0), rtol=1e-10))

# %% [markdown]
# The numbers above: one degree of freedom, energy and constraints kept to round-off, two descriptions that agree to 12
# digits, changes that are about the size of the errors, a gradient that agrees with the difference to six digits, and a
# ladder that leaves the wall at two thirds of the height.

# %%
assert explained.degrees_of_freedom == 1
assert abs(a["angle"] / (-0.75 * 9.81 / 2.5 * np.cos(1.2)) - 1) < 1e-12
assert traj.drift() < 1e-14
assert traj.residual() < 1e-14
assert apart < 1e-12
assert all(0.1 < change / error < 2 for change, error in halved)
assert abs(gradient / difference - 1) < 1e-6
assert abs(leaves_at - 2 / 3) < 1e-5
assert of_rest(one_angle) < 0 < of_rest(upwards) and climbed.drift() < 1e-12
assert "force=" in str(told[0].message)
