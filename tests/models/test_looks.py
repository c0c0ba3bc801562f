"""A model is drawn by the shapes of its file, where its links are; bodies without any as boxes."""

import numpy as np

import lagjax as lj
from lagjax.display import CUBE, CYLINDER, SPHERE, InSpace
from lagjax.integrate.trajectory.subject import subject_of
from lagjax.models.looks import looks_of
from lagjax.models.parts import LinkShape

ARM = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.4 0.4 0.1"/></geometry></visual></link>
  <link name="upper">
    <inertial><origin xyz="0 0 -0.3"/><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.01"/></inertial>
    <visual><origin xyz="0 0 -0.3" rpy="0 1.5707963267948966 0"/>
      <geometry><cylinder radius="0.05" length="0.6"/></geometry></visual>
    <collision><geometry><sphere radius="9"/></geometry></collision>
  </link>
  <link name="fore">
    <inertial><origin xyz="0 0 -0.2"/><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.01"/></inertial>
  </link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 -0.6"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3"/></joint>
</robot>"""


def drawn(system, q):
    """What is drawn of a system at one state."""
    lanes = {name: lj.Pose(*(np.asarray(x)[None] for x in value)) if isinstance(value, tuple) else np.array([value])
             for name, value in q.items()}  # fmt: skip
    found = subject_of(None, system, None).frames(np.zeros(1), lanes)
    assert isinstance(found, InSpace)
    return found


def test_a_model_is_drawn():
    """In either coordinates: the file's cylinder turned as it says, the box of the base, an inertia's box for the rest.

    Twin: the sphere for contacts is not drawn.
    """
    model = lj.read_urdf(ARM)
    positions = {"shoulder": 0.4, "elbow": -0.7}
    frames = [drawn(model.system(), model.state(positions)[0]), drawn(model.joint_system(), positions)]
    for frame in frames:
        solids = [shape for shape in frame.shapes if shape.surface is not None]
        assert [(shape.surface, shape.owner) for shape in solids] == [(CUBE, "fore"), (CUBE, None), (CYLINDER, "upper")]
        # About the y axis by 90 degrees: along x of the link, 0.3 below its joint, which is turned by 0.4 about y.
        corners = frame.corners(solids[2])[0][0]
        along = np.array([np.cos(0.4), 0.0, -np.sin(0.4)])
        centre = -0.3 * np.array([np.sin(0.4), 0.0, np.cos(0.4)])
        np.testing.assert_allclose(
            [((corners - centre) @ along).min(), ((corners - centre) @ along).max()], [-0.3, 0.3], atol=1e-12
        )
        elbow = [frame.place(shape.anchors[0])[0] for shape in frame.shapes if shape.kind == "dot"][-2:]
        np.testing.assert_allclose(elbow, [2 * centre, 2 * centre], atol=1e-12)
    np.testing.assert_allclose(frames[0].poses["fore"], frames[1].poses["fore"], atol=1e-12)


def test_kinds_of_shapes():
    """A capsule is a cylinder with two spheres at its ends, an ellipsoid a scaled sphere; planes, meshes are none."""
    axes = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    shape = lambda kind, size: LinkShape("a", "a", kind, size, np.array([1.0, 2.0, 3.0]), axes, "", "visual")
    found = looks_of([shape("capsule", (0.1, 0.8)), shape("ellipsoid", (1.0, 2.0, 3.0)), shape("plane", (1.0,) * 3),
                      shape("mesh", (1.0,) * 3)], [])  # fmt: skip
    assert [x.surface for x in found] == [CYLINDER, SPHERE, SPHERE, SPHERE]
    # Its z axis is x in space.
    np.testing.assert_allclose([x.anchors[0].point for x in found[1:3]], [[0.6, 2.0, 3.0], [1.4, 2.0, 3.0]])
    assert found[3].size == (1.0, 2.0, 3.0) and found[0].size == (0.1, 0.1, 0.8)
