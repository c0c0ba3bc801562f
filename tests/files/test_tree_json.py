"""Objects as JSON and arrays come back, and a field of another kind is refused."""

import equinox as eqx
import jax
import pytest

import lagjax as lj
from lagjax.files import npz


def test_a_network_comes_back():
    """Layers with their activations come back, and a field of another kind is refused."""
    # As one program each.
    settings = dict(width=4, first=1.0, activation=jax.nn.softplus)
    made = eqx.filter_jit(lambda: lj.learned.Network({"x": 1.0}, key=jax.random.key(0), **settings))
    net, value = made(), eqx.filter_jit(lambda net: net({"x": 0.3}))
    writer = npz.Writer()
    node = writer.down(net, "net")
    again = npz.Reader(dict(writer.arrays).pop).up(node)
    assert eqx.tree_equal(net, again) and value(again) == value(net) != 0.0
    for field, value in (
        ("sizes", "wide"),
        ("sizes", {"list": []}),
        ("angular", {"dict": []}),
        ("mlp", 3),
        ("other", 1),
    ):
        wrong = node | {"fields": node["fields"] | {field: value}}  # pyright: ignore
        with pytest.raises(ValueError, match=f"field {field}"):
            npz.Reader(dict(writer.arrays).pop).up(wrong)


def test_objects_of_flax():
    """An object of flax is refused with the calls that make data of it; twin: another class of its name with others."""
    for module, fix in (("flax.nnx.statelib", "nnx.to_pure_dict"), ("flux", "use numbers, arrays")):
        state = type("State", (), {"__module__": module})()
        with pytest.raises(TypeError, match=f"(?s)params.net is a State.*Fix.*{fix}"):
            npz.Writer().down(state, "params.net")


def test_what_is_nested_too_deep():
    """A list in a list, a hundred times, is written; once more is refused, named by the beginning of its path."""
    inside = lambda depth: [inside(depth - 1)] if depth else 1.0
    npz.Writer().down(inside(npz.DEEPEST), "params")
    with pytest.raises(npz.NotWritable, match=r"params\[0\].* is nested deeper than 100 levels"):
        npz.Writer().down(inside(npz.DEEPEST + 1), "params")
