"""Impacts, friction and what lets go."""
