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
# # Billiards, bounces and a toy woodpecker
#
# A motion can have several phases: each phase is a `lj.System` with its own constraints and forces, and a `lj.Switch`
# leads from one to the next when a guard crosses zero. Switching times are found to the accuracy of the solve,
# velocities jump by the laws of impact, and derivatives work through all of it.

# %%
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np

import lagjax as lj
from lagjax.display import plots as plot
from lagjax.scenes import woodpecker

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 90  # small pictures

# %% [markdown]
# ## A ball that comes to rest
#
# The ball falls in air and loses $1 - e^2$ of its energy at every impact. There would be infinitely many impacts in a
# finite time: `rest=` names the phase in which the ball stays once they have become too slow to matter.


# %%
def falling(t, q, v, params):
    return 0.5 * v**2 - params["g"] * q


def drag(t, q, v, params):
    return params["c"] * jnp.abs(v) ** 3 / 3  # Rayleigh's function of a force c v²


def height(t, q, params):
    return q


flying = lj.System(falling, dissipation=drag)
lying = lj.System(falling, constraints={"floor": lj.Holonomic(height)})
bounce = lj.Switch("flying", to="flying", when=lj.guards.touches(height, 0.8), rest="lying", slower_than=1e-3)
ball = lj.Hybrid({"flying": flying, "lying": lying}, [bounce], most_switches=60)
air = {"g": 9.81, "c": 0.05}
bounced = lj.integrate(ball, 1.0, 0.0, air, ts=jnp.linspace(0.0, 5.0, 401))
bounced

# %%
lj.explain(ball, 0.0, 1.0, 0.0, air)

# %% [markdown]
# The **energy ledger** shows where the energy went: it integrates the power of every force and compares the sum with
# the change of the energy. The difference, the closure, is the error of the motion.

# %%
ledger = lj.energy_ledger(bounced)
ledger

# %%
ledger.plot()

# %% [markdown]
# A drag force with the wrong sign shows at once:

# %%
wrong = lj.System(falling, dissipation=lambda *state: -drag(*state))
lj.energy_ledger(bounced, lj.Hybrid({"flying": wrong, "lying": lying}, [bounce], most_switches=60))

# %% [markdown]
# ## Billiards: two tables
#
# On an elliptic table the product of the angular momenta about the two foci never changes; it is as regular as a
# motion can be. A stadium, two half circles joined by straight sides, is chaotic (Bunimovich 1979). The derivative of
# the state with respect to the initial direction distinguishes them: it works through every bounce.


# %%
def free(t, q, v, params):
    return 0.5 * jnp.vdot(v, v)


def table(t, q, params):
    straight, end = params
    return 1.0 - (jnp.maximum(jnp.abs(q[0]) - straight, 0.0) / end) ** 2 - q[1] ** 2


tables = {"ellipse": (0.0, 2.0), "stadium": (1.0, 1.0)}
reflect = lj.Switch("inside", to="inside", when=lj.guards.touches(table, 1.0))
billiard = lj.Hybrid({"inside": lj.System(free)}, [reflect], most_switches=40)
ts, start = jnp.linspace(0.0, 40.0, 801), jnp.array([0.3, 0.2])


def play(shape, direction, **options):
    velocity = jnp.array([jnp.cos(direction), jnp.sin(direction)])
    return lj.integrate(billiard, start, velocity, shape, ts=ts, **options)


games = {name: play(shape, 0.7) for name, shape in tables.items()}


# %%
@jax.jit
def grown(shape):
    """How far the states of neighbouring games are apart, for a unit of the difference in their directions."""
    places = lambda direction: play(shape, direction, estimate_error=False).q
    return jnp.linalg.norm(jax.jvp(places, (0.7,), (1.0,))[1], axis=1)


growth = {name: grown(shape) for name, shape in tables.items()}
fig, axes = plot.figure(1, 3, size=(3.9, 3.2))
x, y = np.meshgrid(np.linspace(-2.1, 2.1, 301), np.linspace(-1.1, 1.1, 201))
for i, (axis, (name, game)) in enumerate(zip(axes[0], games.items())):
    axis.contour(x, y, table(0.0, np.stack([x, y]), tables[name]), levels=[0.0], colors="black")
    axis.plot(*np.asarray(game.q).T, linewidth=0.9, color=plot.COLOURS[i])
    axis.set(aspect="equal", title=f"{name}: {len(game.switches)} bounces")
    axis.grid(False)
for i, (name, apart) in enumerate(growth.items()):
    axes[0, 2].semilogy(ts[1:], apart[1:], label=name, **plot.style(i))
axes[0, 2].set(xlabel="t", title="|∂q/∂direction|")
axes[0, 2].legend(fontsize=9, frameon=False)
fig


# %% [markdown]
# On the ellipse the derivative grows linearly, on the stadium by a factor of ten in every three bounces. No computation
# can follow a game there for long, and the derivative says for how long: an error of $10^{-9}$ at the start is as large
# as the table after thirty bounces. The error estimate says the same.

# %%
for name, game in games.items():
    print(f"{name}: error of q at t = 40 about {float(jnp.max(game.error.q[-1])):.0e}")
about = lambda game, x: (game.q[:, 0] - x) * game.v[:, 1] - game.q[:, 1] * game.v[:, 0]
product = about(games["ellipse"], np.sqrt(3.0)) * about(games["ellipse"], -np.sqrt(3.0))
print(
    f"ellipse: the product of the angular momenta changes by {float(jnp.ptp(product)):.0e} of {float(product[0]):.4f}"
)

# %% [markdown]
# ## A toy woodpecker
#
# The bird hangs by a spring from a sleeve that is a little wider than its pole. When the bird swings out, an edge of
# the sleeve jams; when it swings back the sleeve slips and falls, until an edge jams again, and the beak hits the pole
# (Glocker 1995). `lagjax.scenes.woodpecker` models it in four phases with friction, both in the impacts and as a force
# that depends on the contact's multiplier.

# %%
toy = woodpecker.motion(woodpecker.PARAMS, np.linspace(0.0, 0.18, 361), estimate_error=False)
lap = woodpecker.lap(toy)
print(f"one period: {float(lap.period):.9f} s, in which the toy falls {-1e3 * float(lap.fallen):.6f} mm")
toy

# %%
names = toy.named_phases()
fig, axes = plot.figure(1, 2, size=(5.4, 3.6))
left, right = axes[0]
shades = {"falls": "white", "slides": "0.85", "rises": "0.6", "sticks": "0.93"}
changes = np.flatnonzero(names[1:] != names[:-1]) + 1
for first, last in zip([0, *changes], [*changes, len(names) - 1]):
    left.axvspan(1e3 * toy.t[first], 1e3 * toy.t[last], color=shades[names[first]], linewidth=0)
left.plot(1e3 * toy.t, toy.q["bird"], label="bird", **plot.style(0))
left.plot(1e3 * toy.t, 10 * toy.q["sleeve"], label="sleeve x 10", **plot.style(1))
left.plot(1e3 * toy.t, 1e-2 * 1e3 * toy.q["y"], label="height / 100 mm", **plot.style(2))
left.set(xlabel="t / ms", ylabel="angle / rad", title="Jammed light grey, sliding grey, falling white")
left.legend(fontsize=9, frameon=False, loc="upper left")
right.plot(toy.q["bird"], toy.v["bird"], linewidth=1.2, color=plot.COLOURS[0])
hits = toy.switches.way == 0
right.plot(toy.switches.q["bird"][hits], toy.switches.v["bird"][hits], "o", color=plot.COLOURS[1], label="beak hits")
right.set(xlabel="angle of the bird / rad", ylabel="its rate / (rad/s)", title="The limit cycle")
right.legend(fontsize=9, frameon=False, loc="lower right")
fig

# %%
assert np.ptp(product) < 1e-9 * abs(product[0])
assert growth["ellipse"][-1] < 1e2 and growth["stadium"][-1] > 1e8
assert abs(float(lap.period) - 0.145976065) < 1e-8
assert ledger.closes and abs(ledger.jacobi_integral[-1]) < 1e-5
