"""Functions of the state that cross zero."""
