"""Write the README's table of speeds from `benchmarks/results/`.

python benchmarks/quote.py
"""

import json
from pathlib import Path

HERE = Path(__file__).parent
README = HERE.parent / "README.md"
BEGIN, END = "<!-- speed -->\n", "<!-- end of speed -->"
# File of results, row in it, and what the README calls it.
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
        "64 links in angles, accelerations / MuJoCo's step",
    ),
    ("gradient_cost", "forward mode, 4 parameters: our gradient / our solve", "gradient by 4 parameters / one solve"),
    ("against_hand_written", "rolling_hoop, single: from L / by hand", "one evaluation, rolling hoop / by hand"),
    ("sweep", "trajectories/s, error 1e-06: lagjax / numba Dopri8", "sweep over 1,000 speeds, error 1e-6 / numba"),
    ("sweep", "trajectories/s, error 1e-06: lagjax / heyoka in batches", "the same / heyoka, eight lanes at a time"),
    ("sweep", "trajectories/s: two cores / one", "the same, two cores / one"),
    ("fit", "one fit: SciPy / lagjax", "a fit of 4 numbers to 100 samples, SciPy's time / ours"),
]


def table() -> str:
    """The table, of the rows that there are."""
    lines = ["| what | ratio | target | |", "|---|---|---|---|"]
    for file, what, name in QUOTED:
        rows = {row["what"]: row for row in json.loads((HERE / "results" / f"{file}.json").read_text())["rows"]}
        row = rows[what]
        target = "" if row["target"] is None else f"{'≤' if row['better'] == 'less' else '≥'} {row['target']:.2g}"
        lines.append(f"| {name} | {row['value']:.2g} | {target} | {'' if row['met'] in (None, True) else 'missed'} |")
    return "\n".join(lines) + "\n"


def quoted(readme: str) -> str:
    """The README with the table in its place."""
    before, rest = readme.split(BEGIN)
    return before + BEGIN + table() + END + rest.split(END)[1]


if __name__ == "__main__":
    README.write_text(quoted(README.read_text()))
