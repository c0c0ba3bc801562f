"""A model is drawn by the shapes of its file, where its links are, bodies without any as boxes; meshes beside a file: a
box as STL in bytes and as text and as OBJ has its volume, and what is no mesh is left out."""

import struct

import numpy as np
import pytest

import lagjax as lj
from lagjax.display import CUBE, CYLINDER, SPHERE, InSpace
from lagjax.integrate.pictures import subject_of
from lagjax.models.links_and_joints import LinkShape, looks_of, mesh_of

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
    lanes = {
        name: lj.bodies.Pose(*(np.asarray(x)[None] for x in value)) if isinstance(value, tuple) else np.array([value])
        for name, value in q.items()
    }
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


MOVING = """<robot name="all">
  <link name="base">{mass}</link>
  <link name="turns">{mass}</link><link name="slides">{mass}</link><link name="floats">{mass}</link>
  <joint name="r" type="continuous"><parent link="base"/><child link="turns"/><origin xyz="1 0 0" rpy="0.3 0.2 0.1"/>
    <axis xyz="0.6 0 0.8"/></joint>
  <joint name="p" type="prismatic"><parent link="turns"/><child link="slides"/><origin xyz="0 0.5 0" rpy="0 1 0"/>
    <axis xyz="0 0.6 0.8"/><limit lower="-3" upper="3"/></joint>
  <joint name="f" type="planar"><parent link="slides"/><child link="floats"/><origin xyz="0.1 0.5 0"/>
    <axis xyz="0.6 0.8 0"/></joint>
</robot>""".format(
    mass='<inertial><origin xyz="0.1 0.2 0.3"/><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
)


def drawn_poses(model, positions):
    """The poses of bodies in a picture of a model."""
    points = model.draw(positions).points
    assert isinstance(points, InSpace)
    return {name: pose[0] for name, pose in points.poses.items()}


def test_positions_of_joints_are_drawn():
    """Each kind of joint moves what it carries as the tree's recursion does, a free base too; by NumPy alone.

    Twin: at other positions it does not.
    """
    positions = {"r": 0.7, "p": -0.4, "f": np.array([0.3, -0.2, 0.5])}
    positions["base"] = lj.bodies.Pose.at((1.0, 2.0, 3.0), axis=(1.0, 2.0, 2.0), angle=0.8)
    model = lj.read_urdf(MOVING, base="free")
    known, _ = model.state(positions)
    here, elsewhere = (drawn_poses(model, x) for x in (positions, positions | {"r": 0.6}))
    for name, pose in known.items():
        np.testing.assert_allclose(here[name][:3], pose.position, atol=1e-12)
        sign = np.sign(here[name][3:] @ np.asarray(pose.quaternion))
        np.testing.assert_allclose(sign * here[name][3:], pose.quaternion, atol=1e-12)
    assert np.abs(elsewhere["floats"][:3] - known["floats"].position).max() > 0.01


def test_meshes_of_mjcf():
    """A tetrahedron is drawn where MuJoCo has its corners, in space; the plane it stands on is said not to be."""
    mujoco = pytest.importorskip("mujoco")
    corners = "0 0 0  1 0 0  0 2 0  0 0 3"
    text = f"""<mujoco model="one"><asset><mesh name="corner" vertex="{corners}"/></asset><worldbody>
      <geom name="floor" type="plane" size="1 1 1"/>
      <body name="part" pos="1 2 3" euler="30 0 50"><joint name="hinge" axis="0 1 0" pos="0.1 0.2 0.3"/>
        <geom type="mesh" mesh="corner" pos="0.5 0 0" euler="0 20 0"/></body></worldbody></mujoco>"""
    model = lj.read_mjcf(text)
    assert "not drawn: planes of 'world'" in str(model) and "meshes" not in str(model)
    points = model.draw({"hinge": 0.7}).points
    assert isinstance(points, InSpace)
    (mesh,) = (shape for shape in points.shapes if shape.surface is not None)
    m = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(m)
    data.qpos[0] = 0.7
    mujoco.mj_forward(m, data)
    place, axes = data.geom_xpos[1], data.geom_xmat[1].reshape(3, 3)
    known = place + m.mesh_vert @ axes.T
    # MuJoCo's corners have single precision.
    np.testing.assert_allclose(points.corners(mesh)[0][0], known, atol=1e-6)
    assert np.ptp(known, axis=0).max() > 2 and len(mesh.surface.faces) == 4


CORNERS = np.array([(x, y, z) for x in (0.0, 1.0) for y in (0.0, 2.0) for z in (0.0, 3.0)])
# Four corners of each side, anticlockwise from outside.
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
TRIANGLES = [CORNERS[list(x)] for a, b, c, d in SIDES for x in ((a, b, c), (a, c, d))]
IN_TEXT = "solid box\n" + "".join(
    "facet normal 0 0 0\n outer loop\n" + "".join(f"  vertex {x:g} {y:g} {z:g}\n" for x, y, z in corners)
    + " endloop\nendfacet\n" for corners in TRIANGLES
) + "endsolid box\n"  # fmt: skip
IN_BYTES = b"solid in bytes".ljust(80) + struct.pack("<I", len(TRIANGLES)) + b"".join(
    struct.pack("<12fH", 0, 0, 0, *corners.reshape(-1), 0) for corners in TRIANGLES
)  # fmt: skip
AS_OBJ = "# box\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "vn 0 0 1\n" + "".join(
    "f " + " ".join(f"{i + 1}//1" for i in side) + "\n" for side in SIDES
)  # fmt: skip
FILES = {"a.stl": IN_TEXT.encode(), "b.STL": IN_BYTES, "c.obj": AS_OBJ.encode()}
HAND = """<robot name="arm"><link name="base"/><link name="hand">
  <inertial><mass value="0.1"/><inertia ixx="9" iyy="9" izz="9"/></inertial>
  <visual><geometry><mesh filename="{mesh}" scale="0.1 0.1 0.1"/></geometry></visual></link>
  <joint name="wrist" type="continuous"><parent link="base"/><child link="hand"/></joint></robot>"""


def volume(of):
    """By the divergence theorem, of triangles."""
    a, b, c = np.moveaxis(of.vertices[of.faces[:, :3]], 1, 0)
    return np.sum(np.cross(a, b) * c) / 6


@pytest.mark.parametrize("name", FILES)
def test_formats(name, tmp_path):
    """Eight vertices, twelve triangles, the volume 6, positive: faces look outward."""
    (tmp_path / name).write_bytes(FILES[name])
    found = mesh_of(name, tmp_path)
    assert found is not None and found.vertices.shape == (8, 3) and found.faces.shape == (12, 4)
    np.testing.assert_allclose(volume(found), 6.0, rtol=1e-12)


def test_what_is_no_mesh(tmp_path):
    """A file that is not there, of another kind, broken or empty: none, and no error."""
    broken = {"a.stl": IN_BYTES[:-20], "b.obj": b"f 1 2 9\nv 0 0 0\n", "c.obj": b"v a b c\n", "d.dae": b"<COLLADA/>",
              "e.stl": b"vertex 1 2 3"}  # fmt: skip
    for name, data in broken.items():
        (tmp_path / name).write_bytes(data)
        assert mesh_of(name, tmp_path) is None, name
    (tmp_path / "f.obj").write_text("v 0 0 0\nf 1 1 " + 40 * "9")
    assert mesh_of("f.obj", tmp_path) is None and mesh_of(5000 * "x", tmp_path) is None
    assert mesh_of("none.stl", tmp_path) is None and mesh_of("a.stl", None) is None
    assert mesh_of("package://arm/a.stl", None) is None


def test_packages(tmp_path):
    """package://arm/... is found in a folder of that name above the file, or without the name."""
    (tmp_path / "arm" / "urdf").mkdir(parents=True)
    (tmp_path / "arm" / "meshes").mkdir()
    (tmp_path / "arm" / "meshes" / "box.stl").write_bytes(IN_BYTES)
    for named in ("package://arm/meshes/box.stl", "package://other/meshes/box.stl", "../meshes/box.stl"):
        assert mesh_of(named, tmp_path / "arm" / "urdf") is not None, named
    assert mesh_of("package://arm/box.stl", tmp_path / "arm" / "urdf") is None


def test_a_hand_is_drawn_by_its_mesh(tmp_path):
    """Scaled as the file says; one that is not there is said, and no box with a made-up inertia hides the rest."""
    (tmp_path / "box.stl").write_bytes(IN_BYTES)
    for mesh, size in (("box.stl", [0.1, 0.2, 0.3]), ("gone.stl", None)):
        (tmp_path / "arm.urdf").write_text(HAND.format(mesh=mesh))
        model = lj.read_urdf(tmp_path / "arm.urdf")
        points = model.draw().points
        assert isinstance(points, InSpace)
        solids = [shape for shape in points.shapes if shape.surface is not None]
        assert ("not drawn: meshes of 'hand' (gone.stl)" in str(model)) == (size is None) == (not solids)
        for shape in solids:
            np.testing.assert_allclose(np.ptp(points.corners(shape)[0][0], axis=0), size, atol=1e-7)
