"""Rigid bodies in space, joints between them and what acts on them: ordinary terms of a Lagrangian, and constraints.

>>> import lagjax as lj
>>> bob = lj.bodies.Body("bob", mass=1.0, inertia=(0.1, 0.1, 0.1))
>>> pivot = lj.bodies.spherical(lj.bodies.ground.at(), bob.at((0.0, 0.0, 1.0)))
>>> pendulum = lj.bodies.multibody([bob], {"pivot": pivot}, [lj.bodies.weight([bob])])
>>> print(list(pendulum.constraints))
['bob is turned', 'pivot']

What they look like in pictures is in `lj.shapes`.
"""

from lagjax.bodies.assemble import multibody, usual_shapes
from lagjax.bodies.body import (
    Body,
    Ground,
    Marker,
    Pose,
    about,
    conjugate,
    ground,
    product,
    rotation_matrix,
    spin_in_body,
    unit_vector,
)
from lagjax.bodies.joints import (
    cylindrical,
    fixed,
    gear,
    named,
    planar,
    prismatic,
    rack_and_pinion,
    revolute,
    spherical,
    universal,
)
from lagjax.bodies.loads import Load, applied, motor, spring, torsion, weight
from lagjax.bodies.tree import Tree
from lagjax.bodies.wheels import Surface, rolling, rolling_ellipsoid, rolling_sphere

__all__ = [
    "Body",
    "Load",
    "Marker",
    "Pose",
    "Surface",
    "Tree",
    "applied",
    "cylindrical",
    "fixed",
    "gear",
    "ground",
    "motor",
    "multibody",
    "planar",
    "prismatic",
    "rack_and_pinion",
    "revolute",
    "rolling",
    "rolling_ellipsoid",
    "rolling_sphere",
    "spherical",
    "spring",
    "torsion",
    "universal",
    "weight",
]
