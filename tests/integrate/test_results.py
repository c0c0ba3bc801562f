"""Results and their messages: each has a number and words of its own."""

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lagjax.integrate.results import RESULTS, ended_well, in_words, is_among, item, message

NAMES = sorted(RESULTS._name_to_item)


@pytest.mark.parametrize("name", NAMES)
def test_each_result_has_words(name):
    """A result is found by its number, and its message is that of no other one."""
    result = getattr(RESULTS, name)
    code = int(result._value)
    assert bool(item(RESULTS.successful, code) == result) and in_words(np.int32(code)) == message(result) != ""
    others = [message(getattr(RESULTS, other)) for other in NAMES if other != name]
    assert message(result) not in others


def test_diffrax_results_keep_their_numbers():
    """A result of diffrax's loop means the same; ours come after them."""
    of_diffrax = {name: int(x._value) for name, x in diffrax.RESULTS._name_to_item.items()}
    assert of_diffrax.items() <= {name: int(getattr(RESULTS, name)._value) for name in NAMES}.items()
    assert int(RESULTS.raised._value) > max(of_diffrax.values())


def test_what_ended_well():
    """A motion to its end or to its event; nothing else, and lane by lane."""
    good = [name for name in NAMES if bool(ended_well(getattr(RESULTS, name)))]
    assert good == ["event_occurred", "successful"]
    codes = jnp.array([int(getattr(RESULTS, name)._value) for name in NAMES])
    lanes = jax.vmap(lambda code: ended_well(item(RESULTS.successful, code)))(codes)
    assert [name for name, well in zip(NAMES, lanes) if well] == good
    assert is_among(RESULTS.raised, [RESULTS.misfit, RESULTS.raised]) and not is_among(RESULTS.raised, [])


def test_used_up_steps_have_a_next_thing_to_do():
    """A program that used up its steps cannot say why; its message says where one learns it, without a guess."""
    words = message(RESULTS.max_steps_reached)
    assert "outside of jit, vmap and grad" in words and "Try increasing" not in words
