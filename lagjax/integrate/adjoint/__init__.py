"""Derivatives of motions, in both modes."""
