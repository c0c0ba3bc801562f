"""The tables of primitives by name: each name is one of a primitive of the JAX that is installed."""

import sys

import diffrax  # noqa: F401  (with the primitives of equinox that it uses)
import jax
import jax.numpy as jnp
import pytest
from jax.extend.core import Primitive

from lagjax.jax_internals import names, one_function
from lagjax.jax_internals.marks import STAYS_A_CALL, marked
from lagjax.mechanics import sparsity, structure
from lagjax.numerics import scalars

# jax 0.12 makes none of these any more.
UP_TO_0_11 = {"closed_call"}
TABLES = {
    f"{module.__name__.removeprefix('lagjax.')}.{name}": set(table)
    for module in (names, one_function, scalars, sparsity, structure)
    for name, table in vars(module).items()
    if name.isupper() and name not in ("ONE_KERNEL", "STAYS_A_CALL") and isinstance(table, (set, dict))
}


def primitives():
    """The names of all primitives that JAX, equinox and lagjax have defined, in the modules that are loaded."""
    # That of the marks is a variable of no module.
    program = jax.make_jaxpr(lambda x: marked(jnp.sin(x), STAYS_A_CALL))(1.0)
    found = {equation.primitive.name for equation in program.eqns}
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("jax", "equinox", "lagjax"):
            found |= {x.name for x in list(vars(module).values()) if isinstance(x, Primitive)}
    return found


def unknown(table):
    """The names of a table that are of no primitive."""
    gone = UP_TO_0_11 if jax.__version_info__ >= (0, 12) else set()
    return sorted(table - primitives() - gone)


@pytest.mark.parametrize("table", TABLES)
def test_each_name_is_one(table):
    """A name that JAX has changed would be treated as unknown, in silence and slower."""
    assert unknown(TABLES[table]) == []


def test_the_tables_are_found():
    """Twin: there are tables in all of the modules, and a misspelt name is seen."""
    assert {name.rsplit(".", 1)[0].split(".")[-1] for name in TABLES} == {
        "names", "one_function", "scalars", "sparsity", "structure",
    }  # fmt: skip
    assert unknown({"sin", "sine"}) == ["sine"]
