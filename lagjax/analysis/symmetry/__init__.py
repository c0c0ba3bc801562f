"""Symmetries and what they conserve."""
