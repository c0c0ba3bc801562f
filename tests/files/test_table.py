"""The table of classes that files may name: each exists, with its fields, and nothing else is found."""

import equinox as eqx
import jax
import pytest

from lagjax.files import table as file_table


class Linear(eqx.Module):
    """A class of the user's, named like one of the table."""

    slope: jax.Array


def test_the_table():
    """Each class of the table exists, with its fields, wherever its package keeps it; nothing else is found.

    A class of the user's is found by its full name, and by its own only if that is not in the table.
    """
    table = file_table.Table([Linear])
    for key in file_table.LISTED:
        package, name = key.split(".")
        cls, fields, of_table = table.class_of(f"{package}._moved.elsewhere", name)
        assert of_table and set(fields) <= {*(file_table.fields_of(cls) or ())} and cls.__name__ == name
    assert table.class_of("equinox.nn._linear", "Linear")[0] is eqx.nn.Linear
    assert table.class_of(__name__, "Linear")[0] is Linear and table.class_of("__main__", "Linear")[0] is Linear
    assert table.function_of("jax._src.nn.functions", "softplus") is jax.nn.softplus
    for module, name in (("os", "system"), ("jax", "jit"), ("equinox", "Partial"), ("lagjax", "System"), ("", "")):
        with pytest.raises(file_table.UnknownClass, match="neither lagjax's nor passed"):
            table.class_of(module, name)
        with pytest.raises(ValueError, match="functions are not read from files"):
            table.function_of(module, name)
