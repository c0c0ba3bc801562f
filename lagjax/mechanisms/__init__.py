"""Well-known multibody and DAE test problems, each with an independently known motion.

Each module contains the physics and the equations in the symbols of its source; `MECHANISM` defines what to integrate
and where the motion must end. `MECHANISMS` lists them by name.
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
