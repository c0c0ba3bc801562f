"""Does a fit of a measured pendulum find the published parameters?

The records are free swings of the University of Washington MultiArm pendulum (Kaheman, Fasel, Bramburger, Strom, Kutz
and Brunton, MIT licence), which are not part of this project. A file is recognised by its columns: `t, theta, dtheta`
is the single pendulum, `t, theta1, theta2, dtheta1, dtheta2` the double one; angles are absolute, pi hangs down.

    python -m benchmarks.accuracy.fit_measured_pendulum double_pendulum.csv --json rows.json

A motion determines only ratios of its Lagrangian's coefficients. With B the moment of the second arm about its joint,

    L/B = A θ1'²/2 + θ2'²/2 + C θ1' θ2' cos(θ1 - θ2) - D cos θ1 - E cos θ2,
    A = (I1 + m1 a1² + m2 L1²)/B,  B = I2 + m2 a2²,  C = m2 a2 L1/B,  D = (m1 a1 + m2 L1) g/B,  E = m2 a2 g/B.

The double pendulum is chaotic: its record is cut into windows, each with its own initial state. The published
parameters are judged on the same windows, with only their initial states fitted.
"""

import argparse
import json
import time

import jax

jax.config.update("jax_enable_x64", True)

import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import lagjax as lj  # noqa: E402

SINGLE = {"a1": 0.147754901, "m1": 0.147584572, "I1": 1.09118505e-4, "k1": 2.23940125e-4, "g": 9.8100131}
DOUBLE = {
    "m1": 0.0938439748, "m2": 0.13759597, "a1": 0.108565215, "a2": 0.116779018, "L1": 0.172719204, "I1": 4.3752943e-4,
    "I2": 1.26882939e-3, "k1": 2.37142783e-4, "k2": 1e-5, "g": 9.80858023,
}  # fmt: skip
# Seconds of the single pendulum's record, and of a window of the double pendulum's.
UNTIL, WINDOW = 20.0, 2.0
# The guess as a multiple of the published values.
OFF = {"A": 1.2, "C": 0.85, "D": 1.2, "E": 0.85, "k1": 2.0, "k2": 2.0}
SOLVE = {"rtol": 1e-8, "atol": 1e-8}


def single_lagrangian(t, q, v, params):
    """L over the moment of inertia."""
    return 0.5 * v**2 - params["w2"] * jnp.cos(q)


def single_friction(t, q, v, params):
    """Viscous friction, and air drag with the square of the speed."""
    return 0.5 * params["viscous"] * v**2 + params["drag"] * jnp.abs(v) ** 3 / 3


def double_lagrangian(t, q, v, params):
    """L over the moment of the second arm about its joint."""
    (a, b), (u, w) = (q["theta1"], q["theta2"]), (v["theta1"], v["theta2"])
    kinetic = 0.5 * params["A"] * u**2 + 0.5 * w**2 + params["C"] * u * w * jnp.cos(a - b)
    return kinetic - params["D"] * jnp.cos(a) - params["E"] * jnp.cos(b)


def double_friction(t, q, v, params):
    """Viscous friction in both joints."""
    return 0.5 * params["k1"] * v["theta1"] ** 2 + 0.5 * params["k2"] * (v["theta2"] - v["theta1"]) ** 2


single = lj.System(single_lagrangian, dissipation=single_friction)
double = lj.System(double_lagrangian, dissipation=double_friction)


def published_double():
    """The coefficients of L/B."""
    p = DOUBLE
    B = p["I2"] + p["m2"] * p["a2"] ** 2
    return {
        "A": (p["I1"] + p["m1"] * p["a1"] ** 2 + p["m2"] * p["L1"] ** 2) / B, "C": p["m2"] * p["a2"] * p["L1"] / B,
        "D": (p["m1"] * p["a1"] + p["m2"] * p["L1"]) * p["g"] / B, "E": p["m2"] * p["a2"] * p["g"] / B,
        "k1": p["k1"] / B, "k2": p["k2"] / B,
    }  # fmt: skip


def row(what, value, published, target, met):
    """One line of the report."""
    return {"what": what, "value": value, "published": published, "target": target, "met": met}


def rms(found):
    """The root mean square of the residuals of all angles together."""
    return float(np.sqrt(np.nanmean(np.stack(list(found.residuals().values())) ** 2)))


def fit_single(t, theta):
    """omega² = m g a / (I + m a²) over the first 20 s."""
    p = SINGLE
    published = p["m1"] * p["g"] * p["a1"] / (p["I1"] + p["m1"] * p["a1"] ** 2)
    record = lj.Record(t[t <= UNTIL], q=theta[t <= UNTIL])
    guess = {"w2": 50.0, "viscous": 0.05, "drag": 0.001}
    found = lj.fit(single, record, guess, units={"w2": "1/s²"}, **SOLVE)
    w2 = float(found.params["w2"])
    rows = [
        row("omega²", w2, published, "within 0.5 %", abs(w2 / published - 1) < 0.005),
        row("rms, rad", rms(found), None, None, None),
    ]
    return found, rows


def fit_double(t, theta1, theta2):
    """The coefficients of L/B over the whole record, in windows."""
    published = published_double()
    record = lj.Record(t, q={"theta1": theta1, "theta2": theta2})
    guess = {name: value * OFF[name] for name, value in published.items()}
    windows = {"window": WINDOW, "joined": False, **SOLVE}
    found = lj.fit(double, record, guess, **windows)
    theirs = lj.fit(double, record, published, free=[], **windows)
    rows = []
    for name, value in zip(found.names, map(float, found.values)):
        off, friction = abs(value / published[name] - 1), name.startswith("k")
        target = None if friction else "within 1 %"
        rows.append(row(name, value, published[name], target, None if friction else off < 0.01))
    rows.append(row("rms, rad", rms(found), rms(theirs), "no worse", rms(found) <= rms(theirs)))
    return found, rows


def main():
    """Fit a file and report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", help="a record, comma-separated with a header")
    parser.add_argument("--json", metavar="OUT", help="write the rows to this file")
    arguments = parser.parse_args()
    with open(arguments.file) as file:
        columns = [name.split("[")[0].strip() for name in file.readline().split(",")]
        data = np.loadtxt(file, delimiter=",").T
    named = dict(zip(columns, data))
    started = time.perf_counter()
    if "theta2" in named:
        found, rows = fit_double(named["t"], named["theta1"], named["theta2"])
    elif "theta" in named:
        found, rows = fit_single(named["t"], named["theta"])
    else:
        raise SystemExit(f"{arguments.file} has the columns {columns}, and needs t, theta or t, theta1, theta2.")
    print(found)
    print(f"\n{time.perf_counter() - started:.0f} s, compiling included\n")
    print(f"{'what':<10} {'value':>12} {'published':>12}  target")
    for r in rows:
        published = "" if r["published"] is None else f"{r['published']:12.6g}"
        verdict = "" if r["met"] is None else "met" if r["met"] else "MISSED"
        print(f"{r['what']:<10} {r['value']:12.6g} {published:>12}  {r['target'] or '':<12} {verdict}")
    if arguments.json:
        with open(arguments.json, "w") as file:
            json.dump(rows, file, indent=1)


if __name__ == "__main__":
    main()
