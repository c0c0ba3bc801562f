"""Rigid bodies in space, joints between them and what acts on them: ordinary terms of a Lagrangian, and constraints."""

from lagjax.bodies.assemble import multibody
from lagjax.bodies.body import Body, Ground, Marker, Pose, ground
from lagjax.bodies.joints import cylindrical, fixed, prismatic, revolute, rolling, rolling_sphere, spherical, universal
from lagjax.bodies.loads import Load, applied, motor, spring, torsion, weight

__all__ = [
    "Body",
    "Ground",
    "Load",
    "Marker",
    "Pose",
    "applied",
    "cylindrical",
    "fixed",
    "ground",
    "motor",
    "multibody",
    "prismatic",
    "revolute",
    "rolling",
    "rolling_sphere",
    "spherical",
    "spring",
    "torsion",
    "universal",
    "weight",
]
