"""Cases of a test that run only before a release, and examples that are slow; `conftest.py` describes the tiers."""

import pytest

# Examples of docstrings that compile programs of their own, for 2 to 10 s.
NAMES = """
    analysis.branches.continue_equilibria analysis.energy.energy_ledger analysis.equilibria.equilibria
    analysis.explain.explain analysis.exponents.floquet analysis.exponents.lyapunov_exponents
    analysis.formulations.action analysis.periodic_orbit.periodic_orbit analysis.poincare.poincare
    analysis.poincare.turning_points exchange.export fit.fit.fit fit.fit.fit_loss
    fit.fit.fit_residuals fit.fit.load_fit fit.uncertainty.identifiability integrate.replay.Replay
    guards.touches integrate.events.event.Crossing numerics.radau.Radau5
    numerics.runge_kutta.Nystrom8 numerics.symplectic.Gauss numerics.symplectic.Splitting sweep.sweep.sweep
    system.constraints.CompliantContact system.constraints.Contact system.constraints.SampledControl
    system.system.Hybrid two_points.connect.connect two_points.geodesic.exponential_map two_points.geodesic.geodesic
    two_points.optimal_control.steer two_points.regulators.TrackingLQR two_points.steering.Steering
    work_precision.work_precision.horizons work_precision.work_precision.work_precision
"""
SLOW_EXAMPLES = {f"lagjax.{name}" for name in NAMES.split()}


def exhaustive_but(kept, cases):
    """All cases, with those not in `kept` marked `exhaustive`."""
    return [case if case in kept else pytest.param(case, marks=pytest.mark.exhaustive) for case in cases]
