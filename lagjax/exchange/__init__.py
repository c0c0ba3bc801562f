"""Ways in and out: models from SymPy, compiled programs for processes without lagjax."""
