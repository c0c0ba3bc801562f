"""Solvers and controllers around diffrax's."""
