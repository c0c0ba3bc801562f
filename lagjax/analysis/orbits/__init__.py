"""Motions that come back, and what happens near them."""
