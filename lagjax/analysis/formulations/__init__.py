"""Other forms of the same mechanics."""

from lagjax.analysis.formulations.action import action
from lagjax.analysis.formulations.hamiltonian import Hamiltonian, hamiltonian
from lagjax.analysis.formulations.latex import EquationsOfMotion, latex
from lagjax.analysis.formulations.routhian import Routhian, routhian
