"""Other forms of the same mechanics."""
