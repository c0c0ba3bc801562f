"""One motion in time."""
