"""Fits: parameters, initial states and learned terms from measured motion."""
