"""Branches of equilibria and orbits."""
