"""The nonlinear program of a steered motion: its derivatives, their sparsity, and the same motion on other meshes."""

import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse as sp

import lagjax as lj
from lagjax.two_points.control_problem import asked
from lagjax.two_points.mesh import Mesh, even
from lagjax.two_points.nonlinear_program import NonlinearProgram
from lagjax.two_points.transcription import Layout, moved

# A skate whose path is also held on a cylinder, for constraints of both kinds.
skate = lj.System(
    lambda t, q, v, p: 0.5 * p["m"] * jnp.sum(v**2) * (1 + 0.1 * q[0] ** 2),
    {
        "edge": lj.Nonholonomic(lambda t, q, v, p: v[0] * jnp.sin(q[2] + p["turn"]) - v[1] * jnp.cos(q[2])),
        "cylinder": lj.Holonomic(lambda t, q, p: q[0] ** 2 + q[1] ** 2 - 1 - 0.1 * t),
    },
    force=lambda t, q, v, p: p["push"][0] * q + p["push"][1] * t,
    dissipation=lambda t, q, v, p: 0.1 * jnp.sum(v**2),
)


def program(count, interpolation):
    """The skate's program on so many elements."""
    start = jnp.array([1.0, 0.0, 0.3]), jnp.zeros(3)

    def cost(t, q, v, u, p):
        return jnp.sum(u["push"] ** 2) * (1 + q[0] ** 2) + t * u["turn"] ** 2 * v[1]

    question = asked(
        skate, {"push": jnp.zeros(2), "turn": 0.1}, start, lambda t, q, v, p: q[2] ** 2 - v[0], cost, {"m": 2.0},
        (0.0, (0.5, 3.0)), lambda t, q, v, p: t * q[1] ** 2, {"v[1]": (-1.0, 1.0)}, None, (2, interpolation), (),
    )  # fmt: skip
    layout = Layout(question.plant, count)
    return layout, NonlinearProgram(layout.blocks(), layout.size, layout.row_count)


@pytest.mark.slow
@pytest.mark.parametrize(
    "interpolation", ["smooth", *(pytest.param(x, marks=pytest.mark.exhaustive) for x in ("linear", "constant"))]
)
def test_derivatives(interpolation):
    """Gradient, Jacobian and Hessian are those of central differences, entry by entry, at random numbers."""
    layout, made = program(3, interpolation)
    generator = np.random.default_rng(1)
    x = generator.normal(size=layout.size)
    x[layout.places["end"]], x[layout.places["parts"]] = 1.3, [0.0, 0.3, 0.55, 1.0]
    y = generator.normal(size=layout.row_count)
    _, _, gradient, entries = made.first_order(x)
    pattern, upper = made.jacobian, made.hessian
    jacobian = sp.coo_matrix((entries, (pattern.rows, pattern.columns)), pattern.shape).toarray()
    half = sp.coo_matrix((made.curvatures(x, 0.7, y), (upper.rows, upper.columns)), upper.shape).toarray()
    hessian = half + np.triu(half, 1).T

    def of_lagrangian(x):
        _, _, gradient, entries = made.first_order(x)
        return 0.7 * gradient + y @ sp.coo_matrix((entries, (pattern.rows, pattern.columns)), pattern.shape)

    h = 1e-6
    for i in range(layout.size):
        e = h * np.eye(layout.size)[i]
        (up, rows_up), (down, rows_down) = made.first_order(x + e)[:2], made.first_order(x - e)[:2]
        assert abs((up - down) / (2 * h) - gradient[i]) < 1e-6 * (1 + abs(gradient[i]))
        np.testing.assert_allclose((rows_up - rows_down) / (2 * h), jacobian[:, i], atol=1e-6, rtol=1e-6)
        second = (of_lagrangian(x + e) - of_lagrangian(x - e)) / (2 * h)
        np.testing.assert_allclose(second, hessian[i], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("interpolation", ["smooth", "linear", "constant"])
def test_the_same_motion_on_other_elements(interpolation):
    """Halved elements carry the same polynomials: the same cost, and the same numbers when every other one is read."""
    layout, made = program(2, interpolation)
    generator = np.random.default_rng(2)
    x = generator.normal(size=layout.size)
    mesh = Mesh(even(2), {})
    x[layout.places["end"]], x[layout.places["parts"]] = 1.3, mesh.parts
    finer, y = moved(layout, x, mesh.halved())
    s = layout.plant.degree
    for old, new in ((1, 2), (0, 0)):
        nodes = x[layout.places["q"]][layout.of_nodes[old]], y[finer.places["q"]][finer.of_nodes[new]]
        np.testing.assert_allclose(nodes[0][0], nodes[1][0], atol=1e-12)
    # The middle of the first element of degree two is the last node of its first half.
    np.testing.assert_allclose(x[layout.places["q"]][1], y[finer.places["q"]][s], atol=1e-12)
    u, w = x[layout.places["controls"]][layout.of_controls], y[finer.places["controls"]][finer.of_controls]
    np.testing.assert_allclose(u.mean(axis=1), w.reshape(2, 2, *w.shape[1:]).mean(axis=(1, 2)), atol=1e-12)
