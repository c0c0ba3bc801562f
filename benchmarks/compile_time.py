"""How long until the first result, and how often is anything compiled again?

Every figure is of a new process, because whatever was traced or compiled in it before would count. Seconds are of the
wall clock, medians of three processes (of one for implicit methods), with the processor's beside them: more than the
wall's where XLA compiles in several threads, less where the process waited.

    import             `import lagjax` after `import jax, diffrax`
    first result       `lj.integrate` of a system never seen: trace, compile, run
    warm cache         the same where JAX's persistent compilation cache holds the programs; what of it is compiling,
                       which JAX reports by the wall clock
    compiled again     programs compiled by a second call: same numbers, other tolerances, parameters, states, times

What to set for the cache: `jax.config.update("jax_compilation_cache_dir", FOLDER)`, and, since JAX leaves out what
compiled in less than a second, `jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)`.

    python benchmarks/compile_time.py [--json FILE] [--only TEXT]
"""

import statistics
import tempfile
import time

from measure import CLOCK, in_new_process, main, row

EXPLICIT, IMPLICIT, CACHED, CACHED_COMPILE, IMPORT = 1.5, 6.0, 0.8, 0.1, 0.3
# Source of the method, what its first result may take, and how many processes are measured.
METHODS = {
    "default": ("None", EXPLICIT, 3),
    "Radau5": ("lj.Radau5()", IMPLICIT, 1),
    "Kvaerno5": ("diffrax.Kvaerno5()", IMPLICIT, 1),
}
SCENES = {
    "pendulum": """
def lagrangian(t, q, v, params):
    return 0.5 * params["l"] ** 2 * v**2 + params["g"] * params["l"] * jnp.cos(q)

system, q0, v0 = lj.System(lagrangian), 1.0, 0.0
""",
    "Cartesian pendulum": """
def lagrangian(t, q, v, params):
    return 0.5 * (v["x"] ** 2 + v["y"] ** 2) - params["g"] * q["y"]

def rod(t, q, params):
    return q["x"] ** 2 + q["y"] ** 2 - params["l"] ** 2

system = lj.System(lagrangian, {"rod": lj.Holonomic(rod)})
q0, v0 = {"x": 1.25, "y": 0.0}, {"x": 0.0, "y": 0.0}
""",
    "double pendulum": """
def lagrangian(t, q, v, params):
    g, l = params["g"], params["l"]
    kinetic = l**2 * (v["one"] ** 2 + 0.5 * v["two"] ** 2 + v["one"] * v["two"] * jnp.cos(q["one"] - q["two"]))
    return kinetic + g * l * (2 * jnp.cos(q["one"]) + jnp.cos(q["two"]))

system, q0, v0 = lj.System(lagrangian), {"one": 1.0, "two": 2.0}, {"one": 0.0, "two": 0.0}
""",
}
START = """
import json, time
import jax, diffrax
import jax.numpy as jnp
import numpy as np
jax.config.update("jax_enable_x64", True)
if CACHE:
    jax.config.update("jax_compilation_cache_dir", CACHE)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)
# The first operation of a process starts JAX's back end, whoever asks for it.
jax.block_until_ready(jnp.arange(3.0) + 1.0)

def timed(function):
    started = time.perf_counter(), time.process_time()
    result = function()
    return time.perf_counter() - started[0], time.process_time() - started[1], result

compiling = []
jax.monitoring.register_event_duration_secs_listener(
    lambda name, seconds, **more: compiling.append(seconds) if name.endswith("backend_compile_duration") else None
)
"""
IMPORT_ONLY = """
wall, cpu, _ = timed(lambda: __import__("lagjax"))
print(json.dumps({"wall": wall, "cpu": cpu}))
"""
FIRST = """
import lagjax as lj
{scene}
params = {{"g": 9.8125, "l": 1.25}}

def first(q0=q0, v0=v0, params=params, end=2.0, tolerance=1e-8):
    ts = np.linspace(0.0, end, 5)
    traj = lj.integrate(system, q0, v0, params, ts=ts, method={method}, rtol=tolerance, atol=tolerance)
    return jax.block_until_ready(traj.q)

wall, cpu, _ = timed(first)
result = {{"wall": wall, "cpu": cpu, "compile": sum(compiling), "programs": len(compiling), "again": {{}}}}
nudged = lambda tree: jax.tree.map(lambda x: x + 1e-12, tree)
changes = {{"tolerance": 1e-6, "params": nudged(params), "q0": nudged(q0), "end": 3.0}}
for what, change in ({{"nothing": None}} | changes).items():
    compiling.clear()
    first(**({{}} if change is None else {{what: change}}))
    result["again"][what] = len(compiling)
print(json.dumps(result))
"""


def measured(source, cache=None):
    """What a new process that runs the source prints."""
    source = f"CACHE = {cache!r}\n{START}{source}"
    return in_new_process(source)


def medians(results):
    """The median of each number in several results; "time" is by the clock that `--processor-time` chooses."""
    found = {key: statistics.median(result[key] for result in results) for key in results[0] if key != "again"}
    return found | {"time": found["cpu" if CLOCK["seconds"] is time.process_time else "wall"]}


def rows(wanted):
    """Import, then each scene by each method."""
    if wanted("import lagjax"):
        found = medians([measured(IMPORT_ONLY) for _ in range(3)])
        yield row("import lagjax", found["time"], IMPORT, wall=found["wall"], cpu=found["cpu"])
    for scene, definition in SCENES.items():
        for method, (solver, target, repeats) in METHODS.items():
            source, name = FIRST.format(scene=definition, method=solver), f"{scene}, {method}"
            if wanted(f"{name}: first result") or wanted(f"{name}: compiled again"):
                results = [measured(source) for _ in range(repeats)]
                found = medians(results)
                yield row(
                    f"{name}: first result", found["time"], target, wall=found["wall"], cpu=found["cpu"],
                    compiling=found["compile"], programs=found["programs"],
                )  # fmt: skip
                again = {name: max(result["again"][name] for result in results) for name in results[0]["again"]}
                yield row(f"{name}: compiled again", sum(again.values()), 0, **again)
            if target == EXPLICIT and wanted(f"{name}: warm cache"):
                with tempfile.TemporaryDirectory() as folder:
                    measured(source, folder)
                    found = medians([measured(source, folder) for _ in range(repeats)])
                yield row(f"{name}: warm cache", found["time"], CACHED, wall=found["wall"], cpu=found["cpu"])
                yield row(f"{name}: warm cache, compiling", found["compile"], CACHED_COMPILE)


if __name__ == "__main__":
    main(rows, __doc__)
