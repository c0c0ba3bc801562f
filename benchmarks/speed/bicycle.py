"""A vehicle in three dimensions: Whipple's bicycle with the published benchmark's masses and lengths.

Two frames that roll on two thin wheels: the body, and the front, which turns in it about the steering axis. x is
forward, y to the right, z down; g is along +z. Nine coordinates: the rear hub (x, y, z), the body's yaw ψ, roll φ and
pitch θ, the steering angle δ, and the angle by which each wheel has turned in its frame. With rotations about fixed
axes,

    body in space   B = R_z(ψ) R_x(φ) R_y(θ)            front in the body   S = 1 + sin δ [e]× + (1 - cos δ) [e]×²

where e = (sin λ, 0, cos λ) is the steering axis, tilted back by λ; it meets the ground in (w + c, 0, 0), the trail c
ahead of the front contact. Every part has the energy ½ m |v|² + ½ ω·I ω + m g z, and the wheels turn on their axles.

A wheel with centre C, radius r and axle n touches the ground with its lowest point, C + r d with
d = (ẑ - n_z n) / √(1 - n_z²):

    contact   C_z + r √(1 - n_z²) = 0                  two of them, holonomic
    no slip   (Ċ + ω × r d)_{x, y} = 0                 two equations each: four, not integrable

Three degrees of freedom of the velocity remain: forward, roll, steering. Linearised about straight running at the speed
u, roll and steering obey

    M (φ̈, δ̈) + u C₁ (φ̇, δ̇) + (g K₀ + u² K₂) (φ, δ) = 0

with the matrices below; the tests compare the accelerations with them.

Source: Meijaard, Papadopoulos, Ruina & Schwab, *Proc. R. Soc. A* 463 (2007) 1955: Table 1, and the benchmark's M, C₁,
K₀, K₂.
"""

import jax.numpy as jnp
import numpy as np

import lagjax as lj

PARAMS = {
    "g": 9.81, "wheelbase": 1.02, "trail": 0.08, "tilt": np.pi / 10,
    "rear": {"r": 0.3, "m": 2.0, "I": np.array([0.0603, 0.12, 0.0603])},
    "front": {"r": 0.35, "m": 3.0, "I": np.array([0.1405, 0.28, 0.1405])},
    # Centres of mass relative to the rear contact, as printed.
    "body": {"m": 85.0, "at": np.array([0.3, 0.0, -0.9]),
             "I": np.array([[9.2, 0.0, 2.4], [0.0, 11.0, 0.0], [2.4, 0.0, 2.8]])},
    "fork": {"m": 4.0, "at": np.array([0.9, 0.0, -0.7]),
             "I": np.array([[0.05892, 0.0, -0.00756], [0.0, 0.06, 0.0], [-0.00756, 0.0, 0.00708]])},
}  # fmt: skip

# The linear equations' matrices, for (roll, steering), as printed.
M = np.array([[80.81722, 2.31941332208709], [2.31941332208709, 0.29784188199686]])
C1 = np.array([[0.0, 33.86641391492494], [-0.85035641456978, 1.68540397397560]])
K0 = np.array([[-80.95, -2.59951685249872], [-2.59951685249872, -0.80329488458618]])
K2 = np.array([[0.0, 76.59734589573222], [0.0, 2.65431523794604]])


def about_axis(x):
    """The matrices of rotation by an angle about x, y and z."""
    c, s = jnp.cos(x), jnp.sin(x)
    one, nil = jnp.ones_like(c), jnp.zeros_like(c)
    rows = lambda *entries: jnp.stack(entries).reshape(3, 3)
    return (
        rows(one, nil, nil, nil, c, -s, nil, s, c),
        rows(c, nil, s, nil, one, nil, -s, nil, c),
        rows(c, -s, nil, s, c, nil, nil, nil, one),
    )


class BicyclePose:
    """Both frames: rotations, angular velocities, and positions and velocities of their parts."""

    def __init__(self, q, v, params):
        _, by_pitch, _ = about_axis(q["pitch"])
        by_roll, _, _ = about_axis(q["roll"])
        _, _, by_yaw = about_axis(q["yaw"])
        tilt, steer = params["tilt"], q["steer"]
        axis = jnp.stack([jnp.sin(tilt), jnp.zeros_like(tilt), jnp.cos(tilt)])
        across = jnp.cross(jnp.eye(3), axis)  # [e]×, which takes x to e × x
        turned = jnp.eye(3) + jnp.sin(steer) * across + (1 - jnp.cos(steer)) * (across @ across)
        self.body = by_yaw @ by_roll @ by_pitch
        self.fork = self.body @ turned
        # Angular velocities, each in its own frame.
        nil = jnp.zeros_like(v["yaw"])
        rolling = by_roll.T @ jnp.stack([nil, nil, v["yaw"]]) + jnp.stack([v["roll"], nil, nil])
        self.body_rate = by_pitch.T @ rolling + jnp.stack([nil, v["pitch"], nil])
        self.fork_rate = turned.T @ self.body_rate + v["steer"] * axis
        self.hub, self.hub_rate = jnp.stack([q["x"], q["y"], q["z"]]), jnp.stack([v["x"], v["y"], v["z"]])
        # All lengths are relative to the rear contact, one radius below the hub.
        self.up = jnp.stack([nil, nil, params["rear"]["r"] + nil])
        self.pivot = jnp.stack([params["wheelbase"] + params["trail"] + nil, nil, nil])

    def on_body(self, at):
        """Position and velocity of a point of the body, given by its place when all angles are zero."""
        arm = at + self.up
        return self.hub + self.body @ arm, self.hub_rate + self.body @ jnp.cross(self.body_rate, arm)

    def on_fork(self, at):
        """The same for a point of the front frame."""
        place, rate = self.on_body(self.pivot)
        arm = at - self.pivot
        return place + self.fork @ arm, rate + self.fork @ jnp.cross(self.fork_rate, arm)

    def wheels(self, v, params):
        """For each wheel: its parameters, position and velocity of its centre, its frame, its rate in that frame."""
        nil = jnp.zeros_like(self.hub[0])
        spin = lambda x: jnp.stack([nil, x, nil])
        rear, front = params["rear"], params["front"]
        before = jnp.stack([params["wheelbase"] + nil, nil, nil - front["r"]])
        return (
            (rear, self.hub, self.hub_rate, self.body, self.body_rate + spin(v["rear"])),
            (front, *self.on_fork(before), self.fork, self.fork_rate + spin(v["front"])),
        )


def lagrangian(t, q, v, params):
    """Two frames and two wheels, each a rigid body."""
    pose = BicyclePose(q, v, params)
    parts = (
        (params["body"], *pose.on_body(params["body"]["at"]), pose.body_rate @ params["body"]["I"] @ pose.body_rate),
        (params["fork"], *pose.on_fork(params["fork"]["at"]), pose.fork_rate @ params["fork"]["I"] @ pose.fork_rate),
        *((wheel, place, rate, turning @ (wheel["I"] * turning))
          for wheel, place, rate, _, turning in pose.wheels(v, params)),
    )  # fmt: skip
    moving = sum(0.5 * part["m"] * (rate @ rate) + 0.5 * turning for part, _, rate, turning in parts)
    return moving + params["g"] * sum(part["m"] * place[2] for part, place, _, _ in parts)


def steepest(frame):
    """The unit vector from a wheel's centre to its lowest point, and √(1 - n_z²)."""
    axle = frame[:, 1]
    upright = jnp.sqrt(1 - axle[2] ** 2)
    return (jnp.array([0.0, 0.0, 1.0]) - axle[2] * axle) / upright, upright


def contact(t, q, params):
    """Heights of the lowest points of both wheels above the ground."""
    still = {name: jnp.zeros_like(x) for name, x in q.items()}
    wheels = BicyclePose(q, still, params).wheels(still, params)
    return jnp.stack([place[2] + wheel["r"] * steepest(frame)[1] for wheel, place, _, frame, _ in wheels])


def slip(t, q, v, params):
    """Velocities along the ground of the points of contact."""
    rates = []
    for wheel, _, rate, frame, turning in BicyclePose(q, v, params).wheels(v, params):
        down, _ = steepest(frame)
        rates.append((rate + wheel["r"] * jnp.cross(frame @ turning, down))[:2])
    return jnp.concatenate(rates)


system = lj.System(lagrangian, {"contact": lj.Holonomic(contact), "no slip": lj.Nonholonomic(slip)})


def straight(speed, roll_rate=0.0, params=PARAMS):
    """Upright and straight ahead, with a roll rate about the line of both contacts: (q, v)."""
    nil = dict.fromkeys(("x", "y", "z", "yaw", "roll", "pitch", "steer", "rear", "front"), 0.0)
    turning = {"rear": -speed / params["rear"]["r"], "front": -speed / params["front"]["r"]}
    tipping = {"roll": roll_rate, "y": roll_rate * params["rear"]["r"]}
    return nil | {"z": -params["rear"]["r"]}, nil | {"x": speed} | tipping | turning
