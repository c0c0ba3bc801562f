"""Meshes beside a file: a box as STL in bytes and as text and as OBJ has its volume; what is no mesh is left out."""

import struct

import numpy as np
import pytest

import lagjax as lj
from lagjax.display import InSpace
from lagjax.models.meshes import mesh_of

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
