"""Import and export: models from SymPy, compiled programs for processes without lagjax."""
