"""How near is `lj.steer` to optima known in closed form or from published problems, and how long does it take?

    least energy     a mass moved by one in one unit of time: J = 12, u = 6 - 12 t
    least time       the same from x = -1, v = 1/2 to rest at 0 with |u| <= 1: T = sqrt(4.5) - 1/2, and when u turns
    brachistochrone  a bead on a wire whose slope is the control: the cycloid's time
    cart-pole        Kelly's swing-up, 1 m in 2 s: the least of the integral of u**2

The least cost of the cart-pole has no closed form. By hand: Hermite and Simpson's rule with explicit equations in
casadi's own symbols, solved by the same Ipopt; it tends to the same number. Dymos's repository has 58.8839489745 for it
(40 elements of that rule, to a thousandth, and no force at the end), which the integrated motion here stays below.

Each is a process of its own: the first answer includes tracing, compiling, all meshes and the integration; the next
one the same question with other numbers. Source: Kelly, *SIAM Review* 59 (2017) 849, §6.

    python -m benchmarks.accuracy.steering [--json FILE] [--only TEXT] [--processor-time]
"""

from typing import NamedTuple

from benchmarks.measure import CLOCK, in_new_process, main, row

DYMOS = 58.8839489745
START = """
import json, time
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
import lagjax as lj
jax.block_until_ready(jnp.arange(3.0) + 1.0)
clock = getattr(time, CLOCK)
"""
END = """
times = []
for scale in (1.0, 1.0 + 1e-9):
    started = clock()
    found = answer(scale)
    times.append(clock() - started)
    kept = found if scale == 1.0 else kept
print(json.dumps({"first": times[0], "again": times[1], "defect": kept.defect, **errors(kept)}))
"""
MASS = """
mass = lj.System(lambda t, q, v, p: 0.5 * v**2, force=lambda t, q, v, p: p["push"])
"""
ENERGY = (
    MASS
    + """
def answer(scale):
    return lj.steer(mass, {"push": 0.0}, (0.0, 0.0), (scale, 0.0), lambda t, q, v, u, p: u["push"] ** 2, t_b=1.0)

def errors(found):
    ts = np.linspace(0.0, 1.0, 101)
    return {"cost": abs(found.cost - 12), "control": float(np.max(np.abs(found.controls.at(ts)[:, 0] - 6 + 12 * ts)))}
"""
)
TIME = (
    MASS
    + """
def answer(scale):
    bounds = {"push": (-1.0, 1.0)}
    return lj.steer(mass, {"push": 0.0}, (-scale, 0.5), (0.0, 0.0), t_b=(0.1, 10.0), bounds=bounds)

def errors(found):
    turn = np.min(np.abs(found.controls.knots - (np.sqrt(4.5) - 1) / 2))
    return {"cost": abs(found.t_b - np.sqrt(4.5) + 0.5), "turn": float(turn)}
"""
)
BRACHISTOCHRONE = """
wire = lj.Nonholonomic(lambda t, q, v, p: v[0] * jnp.sin(p["slope"]) - v[1] * jnp.cos(p["slope"]))
bead = lj.System(lambda t, q, v, p: 0.5 * jnp.sum(v**2) - p["g"] * q[1], {"wire": wire})

def answer(scale):
    start, end = (jnp.array([0.0, 10.0]), jnp.zeros(2)), (jnp.array([10.0 * scale, 5.0]), None)
    bounds = {"slope": (-jnp.pi / 2, jnp.pi / 2)}
    return lj.steer(bead, {"slope": -0.5}, start, end, params={"g": 9.80665}, t_b=(0.5, 5.0), bounds=bounds, tol=1e-9)

def errors(found):
    return {"cost": abs(found.t_b - 1.801603122453)}
"""
CART_POLE = """
def cart_pole(t, q, v, p):
    angle, dx, turn = q["angle"], v["x"], v["angle"]
    kinetic = 0.5 * (p["m1"] + p["m2"]) * dx**2 + p["m2"] * p["l"] * dx * turn * jnp.cos(angle)
    return kinetic + 0.5 * p["m2"] * p["l"] ** 2 * turn**2 + p["m2"] * p["g"] * p["l"] * jnp.cos(angle)

cart = lj.System(cart_pole, force=lambda t, q, v, p: {"x": p["push"], "angle": 0.0})
rest, params = {"x": 0.0, "angle": 0.0}, {"m1": 1.0, "m2": 0.3, "l": 0.5, "g": 9.81}

def answer(scale):
    up, bounds = {"x": scale, "angle": jnp.pi}, {"push": (-20.0, 20.0), "x": (-2.0, 2.0)}
    cost = lambda t, q, v, u, p: u["push"] ** 2
    return lj.steer(cart, {"push": 0.0}, (rest, rest), (up, rest), cost, params, t_b=2.0, bounds=bounds)

def errors(found):
    return {"cost": found.cost}
"""
BY_HAND = """
import json, time
import casadi as ca, numpy as np
clock = getattr(time, CLOCK)

def rate(s, u, m1=1.0, m2=0.3, l=0.5, g=9.81):
    sin, cos, turn = ca.sin(s[1]), ca.cos(s[1]), s[3]
    along = (l * m2 * sin * turn**2 + u + m2 * g * cos * sin) / (m1 + m2 * sin**2)
    round_ = -(l * m2 * cos * sin * turn**2 + u * cos + (m1 + m2) * g * sin) / (l * m1 + l * m2 * sin**2)
    return ca.vertcat(s[2], turn, along, round_)

started = clock()
opti, count = ca.Opti(), 80
s, u, middle, h, cost = opti.variable(4, count + 1), opti.variable(count + 1), opti.variable(count), 2.0 / count, 0
for k in range(count):
    a, b = rate(s[:, k], u[k]), rate(s[:, k + 1], u[k + 1])
    half = (s[:, k] + s[:, k + 1]) / 2 + h / 8 * (a - b)
    opti.subject_to(s[:, k + 1] - s[:, k] == h / 6 * (a + 4 * rate(half, middle[k]) + b))
    cost += h / 6 * (u[k] ** 2 + 4 * middle[k] ** 2 + u[k + 1] ** 2)
opti.subject_to(s[:, 0] == 0)
opti.subject_to(s[:, count] == ca.vertcat(1, np.pi, 0, 0))
opti.subject_to(opti.bounded(-20, u, 20))
opti.subject_to(opti.bounded(-2, s[0, :], 2))
opti.set_initial(s[0, :], np.linspace(0, 1, count + 1))
opti.set_initial(s[1, :], np.pi * np.linspace(0, 1, count + 1))
opti.minimize(cost)
opti.solver("ipopt", {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-10}})
value = float(opti.solve().value(cost))
print(json.dumps({"first": clock() - started, "cost": value}))
"""


class Question(NamedTuple):
    """A question, its source, and the targets of what is measured, by name."""

    name: str
    source: str
    targets: dict[str, float]


QUESTIONS = (
    Question("least energy", ENERGY, {"cost": 1e-9, "control": 1e-9, "defect": 1e-9}),
    Question("least time", TIME, {"cost": 1e-6, "turn": 1e-6, "defect": 1e-6}),
    Question("brachistochrone", BRACHISTOCHRONE, {"cost": 1e-10, "defect": 1e-6}),
)


def rows(wanted):
    """All rows, question by question."""
    clock = f"CLOCK = {CLOCK['seconds'].__name__!r}\n"
    for name, source, targets in QUESTIONS:
        if not wanted(name):
            continue
        found = in_new_process(clock + START + source + END)
        for what, target in targets.items():
            yield row(f"{name}: error of {what}" if what != "defect" else f"{name}: defect", found[what], target)
        yield row(f"{name}: first answer, s", found["first"], again=found["again"])
    if wanted("cart-pole"):
        found = in_new_process(clock + START + CART_POLE + END)
        hand = in_new_process(clock + BY_HAND)
        yield row("cart-pole: cost less that by hand, 80 elements", abs(found["cost"] - hand["cost"]), 1e-5)
        yield row("cart-pole: cost / Dymos's published one", found["cost"] / DYMOS, 1.0, cost=found["cost"])
        yield row("cart-pole: defect", found["defect"], 1e-6)
        yield row("cart-pole: first answer, s", found["first"], 10.0, again=found["again"], by_hand=hand["first"])


if __name__ == "__main__":
    main(rows, __doc__)
