"""Cases of a test that run only before a release, and examples that are slow; `conftest.py` describes the tiers."""

import pytest

# Examples of docstrings that compile programs of their own, for 2 to 10 s.
SLOW_EXAMPLES = {
    "lagjax.analysis.continuation.equilibria.continue_equilibria",
    "lagjax.analysis.continuation.orbits.continue_orbits",
    "lagjax.analysis.energy.energy_ledger",
    "lagjax.analysis.explain.explain",
    "lagjax.analysis.formulations.action.action",
    "lagjax.analysis.equilibria.equilibria.equilibria",
    "lagjax.analysis.orbits.floquet.floquet",
    "lagjax.analysis.orbits.lyapunov.lyapunov_exponents",
    "lagjax.analysis.orbits.periodic_orbit.periodic_orbit",
    "lagjax.analysis.poincare.poincare",
    "lagjax.analysis.poincare.turning_points",
    "lagjax.exchange.standalone_programs.export",
    "lagjax.fit.fit.fit",
    "lagjax.fit.identifiability.identifiability",
    "lagjax.fit.load.load_fit",
    "lagjax.fit.loss.fit_loss",
    "lagjax.fit.loss.fit_residuals",
    "lagjax.integrate.adjoint.replay.Replay",
    "lagjax.integrate.contacts.contacts.touches",
    "lagjax.integrate.events.event.Crossing",
    "lagjax.numerics.methods.gauss.Gauss",
    "lagjax.numerics.methods.nystrom.Nystrom8",
    "lagjax.numerics.methods.radau.Radau5",
    "lagjax.numerics.methods.splitting.Splitting",
    "lagjax.sweep.sweep.sweep",
    "lagjax.system.elements.CompliantContact",
    "lagjax.system.elements.SampledControl",
    "lagjax.system.hybrid.Hybrid",
    "lagjax.two_points.connect.connect",
    "lagjax.two_points.geodesic.exponential_map",
    "lagjax.two_points.geodesic.geodesic",
    "lagjax.two_points.optimal_control.steer",
    "lagjax.two_points.steering.Steering",
    "lagjax.two_points.tracking.TrackingLQR",
    "lagjax.work_precision.over_horizons.horizons",
    "lagjax.work_precision.work_precision.work_precision",
}


def exhaustive_but(kept, cases):
    """All cases, with those not in `kept` marked `exhaustive`."""
    return [case if case in kept else pytest.param(case, marks=pytest.mark.exhaustive) for case in cases]
