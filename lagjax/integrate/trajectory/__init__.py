"""A motion, and what is done with it."""
