"""Rigid bodies in space, joints between them and what acts on them: ordinary terms of a Lagrangian, and constraints."""

from lagjax.bodies.assemble import multibody
from lagjax.bodies.body import Body, Ground, Marker, Pose, ground
from lagjax.bodies.gears import gear, rack_and_pinion
from lagjax.bodies.joints import (
    cylindrical,
    fixed,
    named,
    planar,
    prismatic,
    revolute,
    spherical,
    universal,
)
from lagjax.bodies.loads import Load, applied, motor, spring, torsion, weight
from lagjax.bodies.rotation import about, conjugate, product, rotation_matrix, spin_in_body, unit_vector
from lagjax.bodies.shapes import axis, box, cylinder, disk, line, mesh, rod, sphere, trail, usual_shapes
from lagjax.bodies.tree import Tree
from lagjax.bodies.wheels import Surface, rolling, rolling_ellipsoid, rolling_sphere

__all__ = [
    "Body",
    "Ground",
    "Load",
    "Marker",
    "Pose",
    "Surface",
    "Tree",
    "applied",
    "box",
    "cylinder",
    "cylindrical",
    "disk",
    "fixed",
    "gear",
    "ground",
    "line",
    "mesh",
    "motor",
    "multibody",
    "planar",
    "prismatic",
    "rack_and_pinion",
    "revolute",
    "rod",
    "rolling",
    "rolling_ellipsoid",
    "rolling_sphere",
    "sphere",
    "spherical",
    "spring",
    "torsion",
    "trail",
    "universal",
    "axis",
    "usual_shapes",
    "weight",
]
