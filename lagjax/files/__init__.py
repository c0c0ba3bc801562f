"""How results are written down, and read back as data."""
