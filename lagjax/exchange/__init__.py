"""Import and export: models from SymPy, compiled programs for processes without lagjax."""

from lagjax.exchange.from_sympy import from_sympy, sympy_itself
from lagjax.exchange.standalone_programs import export, result_codes
