"""Worked systems: Lagrangian, parameters, initial state, exact results, source."""
