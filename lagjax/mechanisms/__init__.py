"""Well-known multibody and DAE test problems, each with an independently known motion.

A `Mechanism` says what to integrate and where the motion must end; `MECHANISMS` lists them by name. The physics and the
equations of each, in the symbols of its source, are in `planar.py` and `spatial.py`.
"""

from lagjax.mechanisms.mechanism import Mechanism
from lagjax.mechanisms.planar import (
    andrews,
    car_axis,
    double_pendulum,
    driven_crank,
    n_four_bar,
    slider_crank,
)
from lagjax.mechanisms.spatial import bricard, fekete, governor

MECHANISMS = {
    mechanism.name: mechanism
    for mechanism in (
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
