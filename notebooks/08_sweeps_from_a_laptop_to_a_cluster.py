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
# # Sweeps, from a laptop to a cluster
#
# A bead lies on a hoop that turns with the angular velocity $\omega$, at the angle $\psi_0$ from the bottom, and is
# always pushed upwards with the same velocity. For which $\omega$ and $\psi_0$ does it go over the top? Lengths are in
# radii of the hoop, times in $\sqrt{a/g}$. The [page on sweeps](../docs/from-a-laptop-to-a-cluster.md) continues from
# here to several devices and hosts.

# %%
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import xarray

import lagjax as lj
from lagjax.display import plots as plot

jax.config.update("jax_enable_x64", True)
matplotlib.rcParams["savefig.dpi"] = 80  # small pictures


def lagrangian(t, q, v, params):
    return 0.5 * v**2 + 0.5 * (params["omega"] * jnp.sin(q)) ** 2 + jnp.cos(q)


bead, push = lj.System(lagrangian), 1.8
axes = {"omega": np.linspace(0.0, 4.0, 61), "start": np.linspace(0.02, np.pi - 0.02, 64)}

# %% [markdown]
# ## One call
#
# `run` computes one motion and is an ordinary function of one point; `sweep` calls it at all points of the grid. Here
# the number of steps is limited too strictly on purpose.


# %%
def run_with(max_steps):
    def run(point):
        params, ts = {"omega": point["omega"]}, jnp.array([0.0, 40.0])
        return lj.integrate(bead, point["start"], push, params, ts=ts, max_steps=max_steps).end.q

    return run


hasty = lj.sweep(run_with(250), axes, progress=False)
print(hasty)

# %% [markdown]
# ## Failed points are reported
#
# A point that fails does not stop the others. Its value is NaN (grey in the map), and `status` records the reason; the
# last angle is drawn in units of full turns.

# %%
turns = lambda angle: angle / (2 * np.pi)
hasty.plot(turns)

# %% [markdown]
# `resweep` runs those points again with other settings and keeps the rest.

# %%
swept = hasty.resweep(run_with(4096))
print(swept)

# %% [markdown]
# ## Who goes over the top
#
# A bead that goes over the top has a last angle beyond $\pi$. In the frame of the hoop
# $h = \frac{1}{2}\dot\psi^2 - \frac{1}{2}\omega^2\sin^2\psi - \cos\psi$ is constant, and it is 1 for a bead at rest on
# top: the black line, $h = 1$, should separate the two cases. The map itself is computed only from motions.

# %%
over = swept.values > np.pi
h = 0.5 * push**2 - 0.5 * (axes["omega"][:, None] * np.sin(axes["start"])) ** 2 - np.cos(axes["start"])
print(f"{over.sum()} of {over.size} go over the top; h = 1 tells {np.sum(over != (h > 1))} of them wrong")

fig, panels = plot.figure(size=(5.6, 3.4))
axis = panels[0, 0]
degrees = np.degrees(axes["start"])
rounds = np.where(over, turns(swept.values), np.nan)
axis.set_facecolor("0.9")
shown = axis.pcolormesh(degrees, axes["omega"], rounds, cmap="cividis", shading="nearest", rasterized=True)
axis.contour(degrees, axes["omega"], h, levels=[1.0], colors="black", linewidths=1.5)
axis.annotate("stays on its side", (90.0, 2.5), ha="center", fontsize=9)
axis.grid(False)
axis.set(xlabel=r"start $\psi_0$ / degrees", ylabel=r"$\omega\,\sqrt{a/g}$", title="Over the top. Line: h = 1")
fig.colorbar(shown, label="turns after 40 units of time")
fig

# %% [markdown]
# The faster the hoop, the nearer to the top the bead must start: from the side of a fast hoop the push has to carry it
# inwards, against the centrifugal force. Near the bottom it fails at any speed, because it does not reach the height.
#
# ## With names
#
# `to_xarray` gives values, statuses and axes with their names (it needs xarray: `pip install "lagjax[data]"`).

# %%
data = swept.to_xarray()
one = data["value"].sel(omega=2.0, method="nearest")
print(dict(data.sizes), list(data.data_vars))
print(f"at omega = {float(one.omega):.2f} the first start that goes over: {float(one.start[one > np.pi][0]):.2f} rad")

# %% [markdown]
# ## A store on disk, and a process that dies
#
# With `store=` blocks of points are written when they are finished. Here three processes share the sweep, and only the
# first survives: it computes its `part`, every third block. Any process can read what is on disk, even while others
# write.

# %%
folder = tempfile.TemporaryDirectory()
store = Path(folder.name) / "bead"
run = run_with(4096)
first = lj.sweep(run, axes, store=store, part=(0, 3), chunk=64, progress=False)
on_disk = lj.open_sweep(store)
print(on_disk.counts())
on_disk.plot()

# %% [markdown]
# The same call without `part` computes what is missing. This also works after Ctrl-C, a crash or a power cut: finished
# blocks are not computed again. A further call finds everything done.

# %%
rest = lj.sweep(run, axes, store=store, progress=False)
again = lj.sweep(run, axes, store=store, progress=False)
print(f"computed by the first process {first.ran}, by the second {rest.ran}, by the last call {again.ran}")

# %% [markdown]
# The store is a Zarr group that xarray reads directly, with the axes as dimensions, also where lagjax is not installed.

# %%
in_xarray = xarray.open_zarr(store)
print(dict(in_xarray.sizes), list(in_xarray.data_vars))
agrees = np.array_equal(in_xarray["value"], again.values)

# %% [markdown]
# A store records which sweep it belongs to, and refuses another one.

# %%
try:
    lj.sweep(run, axes | {"omega": axes["omega"] + 1.0}, store=store, progress=False)
except ValueError as error:
    refused = str(error).replace(folder.name, "...")
    print(refused)
together = again.values
folder.cleanup()

# %%
assert 0 < np.sum(~hasty.ok) < hasty.ok.size and np.isnan(hasty.values[~hasty.ok]).all()
assert swept.ok.all() and swept.ran == np.sum(~hasty.ok)
assert np.array_equal(swept.values[hasty.ok], hasty.values[hasty.ok])
assert np.array_equal(over, h > 1) and not over[:, degrees < 45].any()
lowest = np.array([np.min(degrees[of_one]) for of_one in over])
assert np.all(np.diff(lowest) >= 0) and lowest[-1] > 140
assert one.sizes == {"start": 64} and set(data.sizes) == {"omega", "start"}
assert agrees
assert 0 < first.ran < over.size and np.sum(on_disk.ok) == first.ran
assert first.ran + rest.ran == over.size and again.ran == 0
assert np.allclose(together, swept.values, rtol=0, atol=1e-6) and "another sweep" in refused
