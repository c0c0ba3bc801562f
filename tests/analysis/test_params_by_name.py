"""Numbers in params by name: each is read and replaced alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.analysis.arclength import no_such_number, numbers_in

PARAMS = {"spring": {"k": 2.0}, "k": np.array([[1.0, 3.0], [5.0, 7.0]]), "count": 3, "name": "steel", "on": True}


def test_every_float_has_a_name():
    """Floats by path and place; whole numbers, text and conditions have none; a number alone is called params."""
    found = numbers_in(PARAMS)
    assert set(found) == {"spring.k", "k[0, 0]", "k[0, 1]", "k[1, 0]", "k[1, 1]"} and list(numbers_in(2.0)) == [
        "params"
    ]
    assert float(found["spring.k"].get(PARAMS)) == 2.0 and float(found["k[1, 0]"].get(PARAMS)) == 5.0


def test_one_number_is_replaced():
    """All else stays, also in the original; in a program with the derivative by this number alone."""
    number = numbers_in(PARAMS)["k[0, 1]"]
    other = number.put(PARAMS, 9.0)
    assert other["k"].tolist() == [[1.0, 9.0], [5.0, 7.0]] and PARAMS["k"][0, 1] == 3.0
    assert {**other, "k": 0} == {**PARAMS, "k": 0}
    squares = lambda x: jnp.sum(number.put(PARAMS, x)["k"] ** 2)
    slope, again = jax.jit(lambda x: (jax.grad(squares)(x), number.get(number.put(PARAMS, x))))(4.0)
    assert slope == 8.0 and again == 4.0


def test_an_unknown_name_lists_what_there_is():
    """The error names all numbers, and says so where there is none; twin: a name that is known is found."""
    error = no_such_number("spring.c", {"spring": {"k": 2.0, "m": 1.0}}, 'or "energy"')
    assert "along='spring.c' is no number in params; there are 'spring.k' and 'spring.m'" in str(error)
    assert 'or "energy"' in str(error) and "there is 'k'" in str(no_such_number("c", {"k": 2.0}, ""))
    assert "there are none" in str(no_such_number("c", {"count": 3}, ""))
    with pytest.raises(KeyError):
        numbers_in(PARAMS)["spring.c"]
