"""The problems of `against_peers.py` and `sweep.py`, set up in other tools as their users would do it.

Each function takes the problem and returns `prepare(tolerance)`, which returns a function without arguments that solves
it from the start and returns the final state. Work that a user does once (building, compiling) is done outside that
function. Each raises ImportError if its tool is missing.

Functions for lanes solve one problem for many values of one parameter, each to its own end: `parameters` and `ends` are
arrays (lanes,), an acceleration gets the lane's parameter as its last argument, and states are (2, lanes).
"""

import math
from functools import partial

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from scipy import integrate as scipy_integrate

try:
    import numba
except ImportError:
    numba = None
try:
    import heyoka
except ImportError:
    heyoka = None
try:
    import casadi
except ImportError:
    casadi = None
try:
    import mujoco
except ImportError:
    mujoco = None


def needs(module, name):
    """Raise ImportError if a tool is not installed."""
    if module is None:
        raise ImportError(f"{name} is not installed")


def diffrax_as_shipped(field, y0, end):
    """diffrax's Dopri8, its loop, and `field(t, y, args)` by hand."""

    @jax.jit
    def solve(tolerance):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            0.0,
            end,
            None,
            jax.tree.map(jnp.asarray, y0),
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=2**20,
        )
        return jax.tree.map(lambda x: x[-1], solution.ys)

    return lambda tolerance: lambda: solve(jnp.asarray(tolerance))


def numba_dopri8(acceleration, q, v, end):
    """Dopri8 with step size control on two numbers, as one would write it by hand: explicit stages, no arrays.

    `acceleration(q, v)` is compiled by numba. Tableau, error norm and controller are those of diffrax.
    """
    needs(numba, "numba")
    compiled = _njit(acceleration)
    solve = _numba_solver(lambda q, v, parameter: compiled(q, v))
    return lambda tolerance: lambda: solve(q, v, end, tolerance, 0.0)


def numba_dopri8_lanes(acceleration, q, v, ends, parameters):
    """The same for one lane after the other, in one loop that numba compiles too; `acceleration(q, v, parameter)`."""
    needs(numba, "numba")
    solve = _numba_solver(acceleration)

    @_njit
    def lanes(q, v, ends, tolerance, parameters):
        found = np.empty((2, len(ends)))
        for i in range(len(ends)):
            found[0, i], found[1, i] = solve(q, v, ends[i], tolerance, parameters[i])
        return found

    return lambda tolerance: lambda: lanes(q, v, ends, tolerance, parameters)


def _njit(function):
    # By default numba checks every division for zero.
    return numba.njit(function, error_model="numpy")


def _numba_solver(acceleration):
    compiled = _njit(acceleration)
    step = _njit(_written_out(diffrax.Dopri8().tableau, compiled))

    @_njit
    def solve(q, v, end, tolerance, parameter):
        t, h, rate, a = 0.0, 1e-3, v, compiled(q, v, parameter)
        while t < end:
            h = min(h, end - t)
            new_q, new_v, new_a, error_q, error_v = step(q, v, h, rate, a, parameter)
            error_q /= tolerance + tolerance * max(abs(q), abs(new_q))
            error_v /= tolerance + tolerance * max(abs(v), abs(new_v))
            error = math.sqrt(0.5 * (error_q**2 + error_v**2))
            if error <= 1.0:
                t, q, v, rate, a = t + h, new_q, new_v, new_v, new_a
            h *= min(10.0, max(0.2, 0.9 * max(error, 1e-30) ** -0.125))
        return q, v

    return solve


def _written_out(tableau, acceleration):
    """One step as a function of scalars, its source generated from the tableau, so that its zeros cost nothing."""

    def combination(weights, of):
        return " + ".join(f"{float(w)!r} * {of}{j}" for j, w in enumerate(weights) if w)

    lines = ["def step(q, v, h, rate0, a0, parameter):"]
    for i, weights in enumerate(tableau.a_lower, start=1):
        lines += [
            f"    q{i} = q + h * ({combination(weights, 'rate')})",
            f"    rate{i} = v + h * ({combination(weights, 'a')})",
            f"    a{i} = acceleration(q{i}, rate{i}, parameter)",
        ]
    last, error = len(tableau.a_lower), tableau.b_error
    # The last stage is the new state.
    lines.append(
        f"    return q{last}, rate{last}, a{last}, h * ({combination(error, 'rate')}), h * ({combination(error, 'a')})"
    )
    namespace = {"acceleration": acceleration}
    exec("\n".join(lines), namespace)
    return namespace["step"]


def diffrax_lanes(field, y0, ends, parameters, chunk):
    """`jax.vmap` of diffrax's Dopri8 over `chunk` lanes at a time; `field(t, y, parameter)` by hand."""

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, None))
    def solve(end, parameter, tolerance):
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(field),
            diffrax.Dopri8(),
            0.0,
            end,
            None,
            jax.tree.map(jnp.asarray, y0),
            args=parameter,
            stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
            max_steps=2**20,
        )
        return jax.tree.map(lambda x: x[-1], solution.ys)

    def prepare(tolerance):
        def solved():
            parts = [slice(i, i + chunk) for i in range(0, len(ends), chunk)]
            return np.concatenate([np.stack(solve(ends[i], parameters[i], tolerance)) for i in parts], axis=1)

        return solved

    return prepare


def heyoka_taylor(acceleration, q, v, end):
    """heyoka's Taylor integrator; `acceleration(q, v, module)` in heyoka's expressions."""
    needs(heyoka, "heyoka")

    def prepare(tolerance):
        x, u = heyoka.make_vars("x", "u")
        solver = heyoka.taylor_adaptive([(x, u), (u, acceleration(x, u, heyoka))], [q, v], tol=tolerance)

        def solve():
            solver.time, solver.state[:] = 0.0, (q, v)
            solver.propagate_until(end)
            return solver.state.copy()

        return solve

    return prepare


def heyoka_lanes(acceleration, q, v, ends, parameters):
    """heyoka's Taylor integrator in batches as wide as the processor's registers; `acceleration(q, v, module, par)`."""
    needs(heyoka, "heyoka")
    lanes, wide = len(ends), heyoka.recommended_simd_size()
    # The last batch is padded with the first lanes.
    padded = np.resize(np.arange(lanes), (-(-lanes // wide), wide))

    def prepare(tolerance):
        x, u = heyoka.make_vars("x", "u")
        equations = [(x, u), (u, acceleration(x, u, heyoka, heyoka.par[0]))]
        solver = heyoka.taylor_adaptive_batch(equations, np.zeros((2, wide)), tol=tolerance, pars=np.zeros((1, wide)))
        found = np.empty((2, lanes))

        def solve():
            for batch in padded:
                solver.set_time(0.0)
                solver.state[0], solver.state[1], solver.pars[0] = q, v, parameters[batch]
                solver.propagate_until(ends[batch])
                found[:, batch] = solver.state
            return found

        return solve

    return prepare


def scipy_dop853(field, y0, end):
    """SciPy's DOP853; `field(t, y)` in Python."""

    def prepare(tolerance):
        options = {"method": "DOP853", "rtol": tolerance, "atol": tolerance}
        return lambda: scipy_integrate.solve_ivp(field, (0.0, end), y0, **options).y[:, -1]

    return prepare


def scipy_lsoda(field, y0, end):
    """LSODA by `scipy.integrate.odeint`; `field(t, y)` in Python."""

    def prepare(tolerance):
        options = {"tfirst": True, "rtol": tolerance, "atol": tolerance, "mxstep": 10**6}
        return lambda: scipy_integrate.odeint(field, y0, (0.0, end), **options)[-1]

    return prepare


def idas(masses, potential, constraints, q, v, end):
    """SUNDIALS' IDAS by CasADi on the equations of index 1, (q, v) differential and the multipliers algebraic.

    `masses` (n,) constant, `potential(q)` and `constraints(q)` in CasADi's expressions of a list q.
    """
    needs(casadi, "casadi")
    n = len(q)
    x, u = casadi.SX.sym("q", n), casadi.SX.sym("v", n)
    g = casadi.vertcat(*constraints(casadi.vertsplit(x)))
    multipliers = casadi.SX.sym("multipliers", g.numel())
    force = -casadi.gradient(potential(casadi.vertsplit(x)), x)
    rate = casadi.jtimes(g, x, u)
    a = (force + casadi.jtimes(g, x, multipliers, True)) / casadi.DM(masses)
    problem = {
        "x": casadi.vertcat(x, u),
        "z": multipliers,
        "ode": casadi.vertcat(u, a),
        "alg": casadi.jtimes(g, x, a) + casadi.jtimes(rate, x, u),
    }
    start = np.concatenate([q, v])
    # The equations are linear in the multipliers: one Newton step finds the initial ones.
    state = [problem["x"], multipliers]
    linear = [casadi.jacobian(problem["alg"], multipliers), casadi.substitute(problem["alg"], multipliers, 0)]
    matrix, rest = (np.array(x) for x in casadi.Function("start", state, linear)(start, 0))
    z0 = -np.linalg.solve(matrix, rest)[:, 0]

    def prepare(tolerance):
        options = {"reltol": tolerance, "abstol": tolerance, "max_num_steps": 10**6}
        solver = casadi.integrator("solver", "idas", problem, 0.0, end, options)
        return lambda: np.array(solver(x0=start, z0=z0)["xf"])[:, 0]

    return prepare


class MuJoCoChain:
    """N unit masses on a chain of N massless unit rods, hinged; MuJoCo's coordinates are the angles between rods."""

    def __init__(self, links, g, timestep=1e-5):
        needs(mujoco, "mujoco")
        body = '<body pos="0 0 {}"><joint type="hinge" axis="0 1 0"/>{}'
        # A point has no inertia, but MuJoCo requires a little.
        point = '<inertial pos="0 0 -1" mass="1" diaginertia="1e-10 1e-10 1e-10"/>'
        bodies = "".join(body.format(-1 if i else 0, point) for i in range(links)) + "</body>" * links
        option = f'<option timestep="{timestep}" gravity="0 0 {-g}"><flag contact="disable"/></option>'
        self.model = mujoco.MjModel.from_xml_string(
            f'<mujoco><compiler autolimits="true"/>{option}<worldbody>{bodies}</worldbody></mujoco>'
        )
        self.data = mujoco.MjData(self.model)

    def set(self, angles, rates):
        """Set the state of the chain, given by the absolute angles."""
        self.data.qpos[:], self.data.qvel[:] = np.diff(angles, prepend=0.0), np.diff(rates, prepend=0.0)
        self.data.time = 0.0
        mujoco.mj_forward(self.model, self.data)

    def accelerations(self):
        """The accelerations of the absolute angles."""
        return np.cumsum(self.data.qacc)

    def steps(self, count):
        """`mj_step`, looped in C."""
        mujoco.mj_step(self.model, self.data, nstep=count)
