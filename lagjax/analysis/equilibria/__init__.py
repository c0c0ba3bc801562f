"""Rest and steady motion."""
