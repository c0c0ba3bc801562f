"""Trees of bodies in joint coordinates."""

from lagjax.bodies.tree.tree import Tree

__all__ = ["Tree"]
