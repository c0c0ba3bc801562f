"""Meshes: the polynomials on elements, elements that are cut, laid anew and halved, and jumps of controls."""

import jax.numpy as jnp
import numpy as np

from lagjax.two_points.elements import rule_of_degree
from lagjax.two_points.mesh import Jump, Mesh, between, cut, even, highest, jumps_of, laid_anew, places, rows_of


def test_polynomials_on_other_elements():
    """A cubic on uneven elements, by its values at Lobatto's nodes and at Gauss's points, is itself anywhere, also
    beyond the mesh; its highest coefficients are those of Legendre's P₃, 2/5 of x³. Twin: x⁴ is not itself."""
    parts, at = np.array([0.0, 0.3, 1.0]), np.array([-0.1, 0.0, 0.1, 0.3, 0.9, 1.2])
    rule = rule_of_degree(3)
    for nodes, power, is_exact in ((rule.nodes, 3, True), (rule.points, 2, True), (rule.nodes, 4, False)):
        values = (places(parts, nodes) ** power)[rows_of(2, nodes)][..., None]
        assert np.allclose(between(parts, nodes, values, at)[:, 0], at**power, atol=1e-12) == is_exact
    values = (places(parts, rule.nodes) ** 3)[rows_of(2, rule.nodes)][..., None]
    np.testing.assert_allclose(highest(values)[:, 0], 0.4 * (np.diff(parts) / 2) ** 3, rtol=1e-10)


def test_elements_laid_anew():
    """Where the errors h² say that all are equally good, elements stay equal; an error of 100 on one in three draws
    them there."""
    three = jnp.asarray(even(3))
    np.testing.assert_allclose(laid_anew(three, jnp.ones(3), 2), three, atol=1e-15)
    drawn = laid_anew(three, jnp.array([1.0, 100.0, 1.0]), 2)
    assert drawn[0] == 0 and drawn[-1] == 1 and 0.3 < drawn[1] < drawn[2] < 0.7
    np.testing.assert_allclose(cut(drawn)[::2], drawn, atol=1e-15)


def test_meshes():
    """Elements are cut at a jump, near a bound of theirs are moved there, and keep it as they are halved."""
    equal = Mesh(even(4), {})
    uneven = equal.cut_at([Jump(0.6, 0, True), Jump(0.251, 1, False)])
    np.testing.assert_allclose(uneven.parts, [0.0, 0.251, 0.5, 0.6, 0.75, 1.0])
    assert sorted(uneven.jumps) == [1, 3] and sorted(uneven.halved().jumps) == [2, 6] and uneven.halved().count == 10
    low, high = uneven.limits()
    assert np.all(low[[0, 2, 4, 5]] == high[[0, 2, 4, 5]]) and np.all(low[[1, 3]] < high[[1, 3]])
    assert low[3] > uneven.parts[2] and high[3] < uneven.parts[4]


def test_jumps_of_controls():
    """A control that falls from its upper bound to the lower one through a value half way jumps in the middle of that
    element; one that rises without an end of its bounds is not looked at. Twin: a slope over many elements is none."""
    step = np.array([1.0, 1.0, 0.5, 0.0, 0.0])
    found = jumps_of(even(5), np.ones(1), np.stack([step, step], axis=1), np.array([0.0, -np.inf]), np.ones(2))
    assert [(round(x.at, 12), x.control, x.falls) for x in found] == [(0.5, 0, True)]
    slope = np.linspace(1.0, 0.0, 9)[:, None]
    assert jumps_of(even(9), np.ones(1), slope, np.zeros(1), np.ones(1)) == []
