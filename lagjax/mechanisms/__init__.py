"""Well-known multibody and DAE test problems, each with a motion that is known independently.

Each module holds the physics and the equations in the symbols of its source; `MECHANISM` gathers what to integrate
and where it must end. `MECHANISMS` has them by name.
"""

from lagjax.mechanisms import (
    andrews,
    bricard,
    car_axis,
    double_pendulum,
    driven_crank,
    fekete,
    governor,
    n_four_bar,
    slider_crank,
)
from lagjax.mechanisms.mechanism import Mechanism

MECHANISMS = {
    module.MECHANISM.name: module.MECHANISM
    for module in (
        andrews,
        car_axis,
        slider_crank,
        driven_crank,
        n_four_bar,
        bricard,
        governor,
        double_pendulum,
        fekete,
    )
}

__all__ = [
    "MECHANISMS",
    "Mechanism",
    "andrews",
    "bricard",
    "car_axis",
    "double_pendulum",
    "driven_crank",
    "fekete",
    "governor",
    "n_four_bar",
    "slider_crank",
]
