"""Motions that come back, and what happens near them."""

from lagjax.analysis.orbits.floquet import Floquet, floquet
from lagjax.analysis.orbits.lyapunov import LyapunovExponents, lyapunov_exponents
from lagjax.analysis.orbits.periodic_orbit import OrbitWarning, periodic_orbit
from lagjax.analysis.orbits.result import PeriodicOrbit
