"""The printed table of a fit: estimates with their uncertainties, residuals, and what the data do not determine."""

import jax
import numpy as np

from lagjax.mechanics.diagnosis import listed
from lagjax.system import coordinates


def lines_of(fit) -> list[str]:
    """The lines of a fit's table."""
    how = "converged" if bool(fit.rested) else "NOT converged"
    how += ", but the residuals are NOT measurement errors," if bool(fit.misfit.any) else ""
    windows = np.asarray(fit.problem.windows.record)
    lines = [f"Fit: {how} after {int(fit.steps)} steps"]
    tried = int(np.sum(np.isfinite(fit.costs)))
    if tried > 1:
        near = int(np.sum(np.asarray(fit.costs) <= 1.01 * float(fit.cost) + 1e-300))
        lines[0] += f"; {near} of {tried} starts ended here"
    if fit.evaluation is None:
        lines.append(f"  {len(fit.names)} numbers, uncertainties not computed; cost {float(fit.cost):.6g}")
        return lines
    units, rows = dict(fit.units), []
    for name, x, sd in zip(fit.names, np.asarray(fit.values), np.asarray(fit.sd)):
        unit = units.get(name) or units.get(name.partition("[")[0], "")
        rows.append((name, _plus_minus(x, sd), unit))
    many = len(rows) > 40
    rows = rows[:40]
    starts = fit.starts()
    for r, ((q, v), q_sd, v_sd) in enumerate(zip(starts, *fit.start_sd)):
        if r < 4:
            suffix = f" of record {r}" if len(starts) > 1 else ""
            for label, x, sd in (("", q, q_sd), ("v.", v, v_sd)):
                x, sd = (np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(y)]) for y in (x, sd))
                named = zip(coordinates.names(q), x, sd)
                rows += [(f"{label}{name}(0){suffix}", _plus_minus(a, b), "") for name, a, b in named if b != 0]
    width, wide = max(len(row[0]) for row in rows) if rows else 0, max((len(row[1]) for row in rows), default=0)
    lines += [f"  {name:<{width}}  {value:<{wide}}  {unit}".rstrip() for name, value, unit in rows]
    if many:
        lines.append(f"  ... and {len(fit.names) - 40} more")
    if windows.max() + 1 < len(windows):
        lines.append(f"  {len(windows)} windows, each from a start of its own")
    rms = ", ".join(f"{name} {value:.3g}" for name, value in fit.rms().items())
    size = (
        f"chi2/freedom {float(fit.chi2 / fit.freedom):.3g}" if fit.problem.absolute else f"noise {float(fit.noise):.3g}"
    )
    lines.append(f"  residuals: rms {rms}; {size}, {int(fit.freedom)} degrees of freedom")
    lines += _whiteness(fit)
    lines += ["  " + line for line in (repr(fit.identifiability) if fit.names else "").splitlines()[1:]]
    if at := fit.at_bounds():
        lines.append(f"  at a bound: {listed(at)}")
    return lines


def _whiteness(fit):
    lag, count = fit.whiteness(), int(np.sum(np.asarray(fit.known())))
    worst = max(lag, key=lambda name: abs(np.nan_to_num(lag[name])))
    if abs(np.nan_to_num(lag[worst])) < 3 / np.sqrt(max(count / len(lag), 1)):
        return []
    rho = min(lag[worst], 0.999)
    wider = np.sqrt((1 + rho) / (1 - rho)) if rho > 0 else 1.0
    words = f"  NOT white: residuals of {worst} correlate by {lag[worst]:.2f} with the next"
    return [words + (f"; the ± are about {wider:.1f} times too small" if wider > 1.1 else "")]


def _plus_minus(x, sd):
    if not np.isfinite(sd):
        return f"{x:.6g} (not determined)"
    if sd == 0:
        return f"{x:.9g}"
    digits = max(0, int(np.floor(np.log10(abs(x) / sd))) + 2) if x else 2
    digits = min(max(digits, 2), 12)
    return f"{x:#.{digits}g} ± {sd:.2g}"
