"""Sliders in a notebook: a motion that follows its parameters."""

from lagjax.sliders.interact import Knobs, interact
