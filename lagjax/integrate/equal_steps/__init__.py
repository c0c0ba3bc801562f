"""Motions in steps of equal length, for methods that keep what only such steps keep."""
