"""Worked systems: Lagrangian, parameters, initial state, exact results, source.

Each module contains the Lagrangian as a reader of the source would write it, `PARAMS`, an initial state, the
exact results for the tests and the main job, and `MISPRINTS`: errors of the source with their corrections. `SCENE`
collects them for `python -m lagjax`.
"""

from lagjax.scenes import (
    bead_on_hoop,
    cross_rails,
    mass_distributions,
    rolling_hoop,
    sliding_wedge,
    slipping_hoop,
    sphere_geodesic,
)
from lagjax.scenes.potentials import jacobi_elliptic

SCENES = {
    module.SCENE.name: module.SCENE
    for module in (
        sphere_geodesic,
        rolling_hoop,
        slipping_hoop,
        bead_on_hoop,
        mass_distributions,
        sliding_wedge,
        cross_rails,
    )
}

__all__ = [
    "SCENES",
    "bead_on_hoop",
    "cross_rails",
    "mass_distributions",
    "rolling_hoop",
    "sliding_wedge",
    "slipping_hoop",
    "sphere_geodesic",
]
