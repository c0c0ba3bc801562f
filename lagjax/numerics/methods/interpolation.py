"""Dense output of diffrax steps, given by the state at a time."""

import abc

import diffrax
import jax.tree_util as jtu


class Interpolation(diffrax.AbstractLocalInterpolation):
    """A dense output given by the state `at` a time; the change over an interval is the difference of two states."""

    @abc.abstractmethod
    def at(self, t):
        """The state at t."""

    def evaluate(self, t0, t1=None, left=True):
        """The state at t0, or its change from t0 to t1."""
        if t1 is None:
            return self.at(t0)
        return jtu.tree_map(lambda b, a: b - a, self.at(t1), self.at(t0))
