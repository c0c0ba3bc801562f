"""Large systems of many small parts: chains of links in Cartesian coordinates, a net, a chain of bars."""

import jax.numpy as jnp
import numpy as np

import lagjax as lj


def particles(t, q, v, params):
    """Particles of masses m (N,) in a vertical field; the second coordinate points upwards."""
    return 0.5 * jnp.sum(params["m"] * jnp.sum(v**2, axis=1)) - params["g"] * jnp.sum(params["m"] * q[:, 1])


def links(t, q, params):
    """The constraints of a chain hung at the origin, with links of length l."""
    between = jnp.diff(jnp.concatenate([jnp.zeros((1, 2)), q]), axis=0)
    return jnp.sum(between**2, axis=1) - params["l"] ** 2


def chain(count, seed=0):
    """An open chain of one metre with randomly turning links; (system, q, v, params)."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.3, 1.2, count)
    link = np.stack([np.sin(angle), -np.cos(angle)], 1) / count
    turning = rng.normal(size=(count, 1)) * np.stack([-link[:, 1], link[:, 0]], 1)
    params = {"m": rng.uniform(0.5, 2.0, count) / count, "g": 9.81, "l": 1.0 / count}
    system = lj.System(particles, {"links": lj.Holonomic(links)})
    return system, np.cumsum(link, 0), np.cumsum(turning, 0), params


def loop(count):
    """A turning closed chain."""
    angle = 2 * np.pi * np.arange(count) / count
    q = np.stack([np.cos(angle), np.sin(angle)], 1) / (2 * count * np.sin(np.pi / count))
    closed = lj.Holonomic(lambda t, q, params: jnp.sum((q - jnp.roll(q, 1, axis=0)) ** 2, axis=1) - params["l"] ** 2)
    params = {"m": np.ones(count) / count, "g": 9.81, "l": 1.0 / count}
    return lj.System(particles, {"links": closed}), q, np.stack([-q[:, 1], q[:, 0]], 1), params


def net(width, height):
    """A wavy net in space at rest, hung at its two upper corners."""
    place = np.arange(width * height).reshape(height, width)
    pairs = np.concatenate([
        np.stack([place[:, 1:].ravel(), place[:, :-1].ravel()], 1),
        np.stack([place[1:].ravel(), place[:-1].ravel()], 1),
    ])  # fmt: skip
    x, y = (part.ravel().astype(float) for part in np.meshgrid(np.arange(width), -np.arange(height)))
    q = np.stack([x + 0.1 * np.sin(y), y, 0.5 * np.sin(x) + 0.3 * np.cos(y)], 1)
    squares = np.sum((q[pairs[:, 0]] - q[pairs[:, 1]]) ** 2, 1)
    corners = q[[0, width - 1]]
    constraints = {
        "links": lj.Holonomic(lambda t, q, p: jnp.sum((q[pairs[:, 0]] - q[pairs[:, 1]]) ** 2, axis=1) - squares),
        "left": lj.Holonomic(lambda t, q, p: q[0] - corners[0]),
        "right": lj.Holonomic(lambda t, q, p: q[width - 1] - corners[1]),
    }
    params = {"m": np.ones(width * height), "g": 9.81}
    return lj.System(particles, constraints), q, np.zeros(q.shape), params


def bars(count):
    """A chain of uniform bars joined at their ends, x and y of the upper end and the angle of each: M has blocks."""

    def lagrangian(t, q, v, params):
        half, angle = 0.5 * params["l"], q["angle"]
        vx, vy = v["x"] + half * jnp.cos(angle) * v["angle"], v["y"] + half * jnp.sin(angle) * v["angle"]
        turning = params["l"] ** 2 / 12 * v["angle"] ** 2
        kinetic, height = 0.5 * (vx**2 + vy**2 + turning), q["y"] - half * jnp.cos(angle)
        return params["m"] * jnp.sum(kinetic - params["g"] * height)

    def joints(t, q, params):
        x = q["x"] + params["l"] * jnp.sin(q["angle"])
        y = q["y"] - params["l"] * jnp.cos(q["angle"])
        held = lambda end: jnp.concatenate([jnp.zeros(1), end[:-1]])
        return jnp.concatenate([q["x"] - held(x), q["y"] - held(y)])

    angle = np.linspace(0.3, 1.2, count)
    x, y = np.cumsum(np.sin(angle)) / count, -np.cumsum(np.cos(angle)) / count
    q = {"x": x - np.sin(angle) / count, "y": y + np.cos(angle) / count, "angle": angle}
    v = {name: np.zeros(count) for name in q}
    params = {"m": 1.0 / count, "g": 9.81, "l": 1.0 / count}
    return lj.System(lagrangian, {"joints": lj.Holonomic(joints)}), q, v, params
