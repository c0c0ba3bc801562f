"""A sparse nonlinear program whose parts are differentiated by JAX, solved by Ipopt.

    least f(x)   with   below ≤ g(x) ≤ above   and   low ≤ x ≤ high

f and g are sums over blocks (`transcription.py`): so are their derivatives, and which of these vanish is known.

Source: Wächter & Biegler, *Mathematical Programming* 106 (2006) 25; Ipopt and its linear solver come with casadi.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lagjax.refusals import installed


class SolverAnswer(NamedTuple):
    """A solution x, its cost, the equations' values and multipliers, and the solver's status and iterations."""

    x: np.ndarray
    cost: float
    rows: np.ndarray
    status: str
    iterations: int


class FirstDerivatives(NamedTuple):
    """f, g, the gradient of f, and the entries of the Jacobian of g."""

    f: float
    g: np.ndarray
    gradient: np.ndarray
    jacobian: np.ndarray


class _Pattern:
    """A sum of dense blocks as a sparse matrix: which entries there are, and where each block adds to them."""

    def __init__(self, shape: tuple[int, int], rows: Sequence[np.ndarray], columns: Sequence[np.ndarray], upper: bool):
        i = np.concatenate(
            [np.broadcast_to(r[:, :, None], (*r.shape, c.shape[1])).ravel() for r, c in zip(rows, columns)]
        )
        j = np.concatenate(
            [np.broadcast_to(c[:, None, :], (*r.shape, c.shape[1])).ravel() for r, c in zip(rows, columns)]
        )
        self.kept = np.flatnonzero(i <= j) if upper else np.arange(i.size)
        # By columns, as casadi stores a matrix.
        key = j[self.kept] * shape[0] + i[self.kept]
        entries, self.place = np.unique(key, return_inverse=True)
        self.shape, self.rows, self.columns = shape, entries % shape[0], entries // shape[0]

    def sum(self, blocks: Sequence[np.ndarray]) -> np.ndarray:
        """The entries of the matrix."""
        values = np.concatenate([b.ravel() for b in blocks])[self.kept]
        return np.bincount(self.place, values, minlength=self.rows.size)


class NonlinearProgram:
    """The program of these blocks for so many unknowns and equations."""

    def __init__(self, blocks: Sequence[Any], size: int, count: int):
        self.blocks, self.size, self.count = blocks, size, count
        self.last: tuple[np.ndarray, FirstDerivatives] | None = None
        columns = [b.columns for b in blocks]
        self.jacobian = _Pattern((count, size), [b.rows for b in blocks], columns, False)
        self.hessian = _Pattern((size, size), columns, columns, True)

    def first_order(self, x: np.ndarray) -> FirstDerivatives:
        """f, g, the gradient of f and the entries of the Jacobian of g; the last ones are kept."""
        if self.last is not None and np.array_equal(self.last[0], x):
            return self.last[1]
        f, g, gradient, parts = 0.0, np.zeros(self.count), np.zeros(self.size), []
        for b in self.blocks:
            (cost, rows), (of_cost, of_rows) = b.values_and_slopes(x)
            f += float(np.sum(cost))
            np.add.at(g, b.rows, rows)
            np.add.at(gradient, b.columns, of_cost)
            parts.append(of_rows)
        self.last = x.copy(), FirstDerivatives(f, g, gradient, self.jacobian.sum(parts))
        return self.last[1]

    def curvatures(self, x: np.ndarray, share: float, multipliers: np.ndarray) -> np.ndarray:
        """The entries of the upper half of the Hessian of share f + multipliers g."""
        return self.hessian.sum([b.curvatures(x, share, multipliers) for b in self.blocks])

    def solve(
        self,
        x: np.ndarray,
        limits: tuple[np.ndarray, np.ndarray],
        of_rows: tuple[np.ndarray, np.ndarray],
        options: dict,
    ) -> SolverAnswer:
        """Ipopt's solution from the guess `x`, between these limits of x and of g."""
        casadi = import_casadi()
        functions = _functions(casadi, self)
        solver = casadi.nlpsol(
            "steer", "ipopt", functions["oracle"],
            {
                "grad_f": functions["grad_f"], "jac_g": functions["jac_g"], "hess_lag": functions["hess_lag"],
                "no_nlp_grad": True, "print_time": False, "show_eval_warnings": False, "error_on_fail": False,
                "ipopt": {"print_level": 0, "sb": "yes", **options},
            },
        )  # fmt: skip
        found = solver(x0=x, lbx=limits[0], ubx=limits[1], lbg=of_rows[0], ubg=of_rows[1])
        stats = solver.stats()
        at = np.asarray(found["x"]).ravel()
        return SolverAnswer(
            at, float(found["f"]), np.asarray(found["g"]).ravel(), stats["return_status"], int(stats["iter_count"])
        )


def import_casadi():
    """casadi, which brings Ipopt with it."""
    return installed("casadi", "lj.steer, which solves its nonlinear program by casadi's Ipopt,", "steer")


def _functions(casadi: Any, program: NonlinearProgram) -> dict[str, Any]:
    """f and g and their derivatives as casadi's functions, in the signatures that its Ipopt takes."""
    n, m = program.size, program.count
    dense = casadi.Sparsity.dense
    x, no_parameters, g, one = dense(n, 1), dense(0, 1), dense(m, 1), dense(1, 1)
    of_rows, of_second = (_sparsity(casadi, p) for p in (program.jacobian, program.hessian))

    class Function(casadi.Callback):
        def __init__(self, name: str, function: Any, takes: Sequence[Any], returns: Sequence[Any]):
            casadi.Callback.__init__(self)
            self.function, self.takes, self.returns = function, takes, returns
            self.construct(name, {})

        def get_n_in(self):
            return len(self.takes)

        def get_n_out(self):
            return len(self.returns)

        def get_name_in(self, i: int):
            return ("x", "p", "lam_f", "lam_g")[i]

        def get_name_out(self, i: int):
            return "fg"[i]

        def get_sparsity_in(self, i: int):
            return self.takes[i]

        def get_sparsity_out(self, i: int):
            return self.returns[i]

        def eval(self, arguments: Sequence[Any]):
            given = [np.asarray(x.nonzeros(), float) for x in arguments]
            return [casadi.DM(s, v) for s, v in zip(self.returns, self.function(*given))]

    def values(x: np.ndarray, _: np.ndarray):
        return program.first_order(x)[:2]

    def gradient(x: np.ndarray, _: np.ndarray):
        found = program.first_order(x)
        return found.f, found.gradient

    def jacobian(x: np.ndarray, _: np.ndarray):
        found = program.first_order(x)
        return found.g, found.jacobian

    def hessian(x: np.ndarray, _: np.ndarray, share: np.ndarray, multipliers: np.ndarray):
        return [program.curvatures(x, share[0], multipliers)]

    return {
        "oracle": Function("nlp", values, [x, no_parameters], [one, g]),
        "grad_f": Function("grad_f", gradient, [x, no_parameters], [one, x]),
        "jac_g": Function("jac_g", jacobian, [x, no_parameters], [g, of_rows]),
        "hess_lag": Function("hess_lag", hessian, [x, no_parameters, one, g], [of_second]),
    }


def _sparsity(casadi: Any, pattern: _Pattern):
    starts = np.searchsorted(pattern.columns, np.arange(pattern.shape[1] + 1))
    return casadi.Sparsity(*pattern.shape, starts.tolist(), pattern.rows.tolist())
