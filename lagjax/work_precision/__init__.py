"""Error against run time and against evaluations, of several methods on one motion."""
