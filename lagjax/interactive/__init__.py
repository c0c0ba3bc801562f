"""Sliders in a notebook: a motion that follows its parameters."""

from lagjax.interactive.interact import Knobs, interact

__all__ = ["interact", "Knobs"]
