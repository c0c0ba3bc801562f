"""Write the README's tables of errors over run times and of speeds from `benchmarks/results/`.

python -m benchmarks.quote
"""

import json
from pathlib import Path

HERE = Path(__file__).parent
README = HERE.parent / "README.md"
# Motions in `work_precision.json`, and their names in the README.
MOTIONS = {
    "sphere_geodesic, embedded": "great circle on a sphere, in space, 1 multiplier",
    "rolling_hoop": "hoop rolling off a cylinder, 2 multipliers",
    "bead_on_hoop": "bead on a rotating hoop",
    "mass_distributions, helix": "orbit in the field of a helix of mass",
    "cross_rails, rotating": "carriage on rotating cross-rails",
    "Cartesian pendulum": "pendulum on a rod, 1 multiplier",
}
ERRORS = ("1e-04", "1e-06", "1e-08", "1e-10")
# File of results, row in it, and its name in the README.
QUOTED = [
    ("against_peers", "bead: lagjax / numba Dopri8", "bead on a hoop, 100 periods / numba, written by hand"),
    ("against_peers", "bead: lagjax / diffrax as shipped", "the same / diffrax, acceleration by hand"),
    ("against_peers", "bead: lagjax / heyoka", "the same / heyoka (Taylor)"),
    (
        "against_peers",
        "pendulum: Cartesian with multiplier / angle",
        "pendulum on a rod, with its multiplier / in its angle",
    ),
    ("against_peers", "slider-crank: lagjax / IDAS", "slider-crank, 7 coordinates and 6 constraints / SUNDIALS IDAS"),
    (
        "against_peers",
        "chain, 64 links: right-hand side / MuJoCo's step",
        "64 links, L by hand in angles, accelerations / MuJoCo's step",
    ),
    ("trees", "evaluation / mj_forward, N = 64", "the same 64 links as `lj.bodies.Tree`"),
    ("gradient_cost", "forward mode, 4 parameters: our gradient / our solve", "gradient by 4 parameters / one solve"),
    ("against_hand_written", "rolling_hoop, single: from L / by hand", "one evaluation, rolling hoop / by hand"),
    ("sweep", "trajectories/s, error 1e-06: lagjax / numba Dopri8", "sweep over 1,000 speeds, error 1e-6 / numba"),
    ("sweep", "trajectories/s, error 1e-06: lagjax / heyoka in batches", "the same / heyoka, eight lanes at a time"),
    ("sweep", "trajectories/s: two cores / one", "the same, two cores / one"),
    ("fit", "one fit: SciPy / lagjax", "a fit of 4 numbers to 100 samples, SciPy's time / ours"),
]


def accuracy() -> str:
    """The table of run times by error."""
    times = {row["what"]: row["default ms"] for row in rows("work_precision")}
    lines = [f"| ms to an error of | {' | '.join(ERRORS)} |", "|---" * (len(ERRORS) + 1) + "|"]
    for motion, name in MOTIONS.items():
        took = [f"{times[f'{motion}, error {error}']:.2g}" for error in ERRORS]
        lines.append(f"| {name} | {' | '.join(took)} |")
    return "\n".join(lines) + "\n"


def speed() -> str:
    """The table of speeds."""
    lines = ["| what | ratio | target | |", "|---|---|---|---|"]
    for file, what, name in QUOTED:
        row = next(row for row in rows(file) if row["what"] == what)
        target = "" if row["target"] is None else f"{'≤' if row['better'] == 'less' else '≥'} {row['target']:.2g}"
        lines.append(f"| {name} | {row['value']:.2g} | {target} | {'' if row['met'] in (None, True) else 'missed'} |")
    return "\n".join(lines) + "\n"


def rows(file: str) -> list[dict]:
    """The rows of one file of results."""
    return json.loads((HERE / "results" / f"{file}.json").read_text())["rows"]


def quoted(readme: str) -> str:
    """The README with the tables inserted."""
    for name, table in (("accuracy", accuracy()), ("speed", speed())):
        begin, end = f"<!-- {name} -->\n", f"<!-- end of {name} -->"
        before, rest = readme.split(begin)
        readme = before + begin + table + end + rest.split(end)[1]
    return readme


if __name__ == "__main__":
    README.write_text(quoted(README.read_text()))
