"""URDF as lagjax and as MuJoCo read it, each against the numbers in the file; and what MuJoCo's reading loses.

The second half is the reason why there are two readers. Once MuJoCo mends what is listed there, its rows turn red.
"""

import re
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import pytest

import lagjax as lj
from lagjax.refusals import installed
from tests.models.test_links_and_joints import ARM, MOVING
from tests.models.test_readers import BODY, PENDULUM, arm, two_links

mujoco = installed("mujoco", "a test", "models")

# As MuJoCo must be asked, so that it keeps links apart and numbers as they are.
ASKED = '<mujoco><compiler fusestatic="false" discardvisual="false" strippath="false" balanceinertia="false"/></mujoco>'
ROBOTS = {"pendulum": PENDULUM, "arm": arm(), "shapes": ARM, "planar": MOVING}
KINDS = {"revolute": "revolute", "continuous": "revolute", "prismatic": "prismatic", "planar": "planar"}


class Moments(NamedTuple):
    """Mass, first and second moments about the origin of a link's frame, along its axes: they add up."""

    mass: float
    first: np.ndarray
    second: np.ndarray

    @staticmethod
    def of(mass, centre, inertia) -> "Moments":
        return Moments(mass, mass * centre, inertia + mass * (centre @ centre * np.eye(3) - np.outer(centre, centre)))

    def __add__(self, other):
        return Moments(*(x + y for x, y in zip(self, other)))


class Part(NamedTuple):
    """A link: its mass, centre and inertia about it; what holds it, and where its frame is in its parent's."""

    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    parent: str | None
    kind: str
    joint: str
    origin: np.ndarray
    axes: np.ndarray
    axis: np.ndarray
    damping: float


def moving(parts):
    """By moving link, the moments of it with what is fixed to it, and its joint: parent, place, axes, axis, damping."""

    def held(name):
        """The moving link that a link is part of, and where it is on it."""
        part = parts[name]
        if part.kind != "fixed":
            return name, np.zeros(3), np.eye(3)
        if part.parent is None:
            return None, part.origin, part.axes
        head, origin, axes = held(part.parent)
        return head, origin + axes @ part.origin, axes @ part.axes

    moments, joints = {}, {}
    for name, part in parts.items():
        head, origin, axes = held(name)
        one = Moments.of(part.mass, origin + axes @ part.centre, axes @ part.inertia @ axes.T)
        moments[head] = moments[head] + one if head in moments else one
        if part.kind != "fixed":
            above, origin, axes = (None, np.zeros(3), np.eye(3)) if part.parent is None else held(part.parent)
            place = origin + axes @ part.origin, axes @ part.axes
            joints[name] = part.kind, part.joint, above, *place, part.axis, part.damping
    return {name: moments[name] for name in joints}, joints


def turned(r, p, y):
    """Rz(y) Ry(p) Rx(r), by hand."""
    (cr, cp, cy), (sr, sp, sy) = np.cos((r, p, y)), np.sin((r, p, y))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ about_y @ about_x


def as_written(text):
    """The numbers of a file, by Python's own reader of XML."""
    robot = ElementTree.fromstring(text)

    def vector(x, key, default=(0.0, 0.0, 0.0)):
        return np.array(default if x is None or key not in x.attrib else x.get(key).split(), float)

    def place(x):
        x = None if x is None else x.find("origin")
        return vector(x, "xyz"), turned(*vector(x, "rpy"))

    parts, above = {}, {x.find("child").get("link"): x for x in robot.findall("joint")}
    for link in robot.findall("link"):
        inertial, joint = link.find("inertial"), above.get(link.get("name"))
        centre, axes = place(inertial)
        mass, inertia = 0.0, np.zeros((3, 3))
        if inertial is not None:
            mass = float(inertial.find("mass").get("value"))
            xx, yy, zz, xy, xz, yz = (float(inertial.find("inertia").get(f"i{key}", "0"))
                                      for key in ("xx", "yy", "zz", "xy", "xz", "yz"))  # fmt: skip
            inertia = axes @ [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]] @ axes.T
        held = None, "fixed", "", np.zeros(3), np.eye(3), np.zeros(3), 0.0
        if joint is not None:
            axis = vector(joint.find("axis"), "xyz", (1.0, 0.0, 0.0))
            dynamics = joint.find("dynamics")
            damping = 0.0 if dynamics is None else float(dynamics.get("damping", "0"))
            kind = KINDS.get(joint.get("type"), joint.get("type"))
            parent = joint.find("parent").get("link")
            held = parent, kind, joint.get("name"), *place(joint), axis / np.linalg.norm(axis), damping
        parts[link.get("name")] = Part(mass, centre, inertia, *held)
    return moving(parts)


def by_lagjax(text):
    """The same from a model."""
    model = lj.read_urdf(text)
    moments = {name: Moments.of(link.mass, link.centre, link.inertia) for name, link in model.links.items()}
    return moments, {
        x.child: (x.kind, x.name, x.parent, *x.placement, x.axis, x.damping) for x in model.joints.values()
    }


def spec_of(text):
    """MuJoCo's reading, with every product of inertia, which it wants, and no meshes, which it would open."""
    text = re.sub(r"<mujoco>.*</mujoco>", "", text)
    text = re.sub("(<robot[^>]*>)", rf"\1{ASKED}", text, count=1)
    for key in ("ixy", "ixz", "iyz"):
        text = re.sub(rf"<inertia ((?:(?!{key})[^>])*)/>", rf'<inertia \1 {key}="0"/>', text)
    spec = mujoco.MjSpec.from_string(text)
    for x in [*spec.geoms, *spec.meshes]:
        spec.delete(x)
    return spec


def by_mujoco(text):
    """The same from MuJoCo's compiled model; of a planar joint's three the last has the axis."""
    m = spec_of(text).compile()
    names = [m.body(i).name for i in range(m.nbody)]
    parts = {}
    for i in range(1, m.nbody):
        joints = range(m.body_jntadr[i], m.body_jntadr[i] + m.body_jntnum[i])
        kind = {0: "fixed", 3: "planar"}.get(len(joints), "one")
        axis, name, damping = np.zeros(3), "", 0.0
        if joints:
            k = joints[-1]
            axis, name, damping = m.jnt_axis[k], m.joint(k).name.removesuffix("_RZ"), m.dof_damping[m.jnt_dofadr[k]]
            kind = {2: "prismatic", 3: "revolute"}[int(m.jnt_type[k])] if kind == "one" else kind
        axes, own = (np.reshape(rotated(x), (3, 3)) for x in (m.body_quat[i], m.body_iquat[i]))
        parent = None if m.body_parentid[i] == 0 else names[m.body_parentid[i]]
        inertia = own @ np.diag(m.body_inertia[i]) @ own.T
        parts[names[i]] = Part(
            m.body_mass[i], m.body_ipos[i], inertia, parent, kind, name, m.body_pos[i], axes, axis, damping
        )
    return moving(parts)


def rotated(quaternion):
    """MuJoCo's own rotation matrix."""
    found = np.zeros(9)
    mujoco.mju_quat2Mat(found, quaternion)
    return found


def farthest(found, expected):
    """The largest difference between two readings, by what it is of; infinite where they have not the same parts."""
    if found[1].keys() != expected[1].keys() or any(found[1][x][:3] != expected[1][x][:3] for x in found[1]):
        return {"parts": np.inf}
    apart = {}
    for k, what in enumerate(("mass", "first moment", "second moment")):
        apart[what] = max(np.abs(found[0][x][k] - expected[0][x][k]).max() for x in found[0])
    for k, what in enumerate(("place", "axes", "axis", "damping"), 3):
        apart[what] = max(np.abs(found[1][x][k] - expected[1][x][k]).max() for x in found[1])
    return apart


@pytest.mark.parametrize("robot", ROBOTS)
def test_numbers_of_a_file(robot):
    """Masses, centres, inertias, joints, places, axes, dampers: lagjax and MuJoCo both take what is written, to 1e-12.

    Twin: of another file they take something else.
    """
    written = as_written(ROBOTS[robot])
    other = re.sub(
        '<axis xyz="[^"]*"', '<axis xyz="0.48 0.6 0.64"', ROBOTS[robot].replace('mass value="', 'mass value="1')
    )
    for read in (by_lagjax, by_mujoco):
        assert max(farthest(read(ROBOTS[robot]), written).values()) < 1e-12
        apart = farthest(read(other), written)
        assert apart["mass"] > 0.1 and apart["axis"] > 0.1


COUPLED = two_links(beside=f'<link name="b">{BODY}</link><joint name="o" type="continuous"><parent link="rod"/>'
                    '<child link="b"/><mimic joint="hinge" multiplier="2"/></joint>')  # fmt: skip


@pytest.mark.parametrize("robot", ROBOTS)
@pytest.mark.parametrize(
    ("what", "tag", "key"), [("limits", "limit", "lower"), ("dry friction", "dynamics", "friction")]
)
def test_what_is_not_taken(robot, what, tag, key):
    """Limits and dry friction are listed for the joints for which MuJoCo and the file have them; twin: without them."""
    joints = ElementTree.fromstring(ROBOTS[robot]).findall("joint")
    written = {x.get("name") for x in joints if x.find(f"{tag}[@{key}]") is not None}
    # A continuous joint has no limits, whatever its file says.
    idle = {x.get("name") for x in joints if x.get("type") in ("fixed", "continuous" if what == "limits" else "")}
    for text, has in ((ROBOTS[robot], written), (re.sub(f"<{tag} [^>]*>", "", ROBOTS[robot]), set())):
        m = spec_of(text).compile()
        flags = m.jnt_limited if what == "limits" else m.dof_frictionloss[m.jnt_dofadr]
        assert {x.name for x in lj.read_urdf(text).not_taken if x.what == what} == has
        assert {m.joint(k).name for k in range(m.njnt) if flags[k]} == has - idle


def test_coupled_joints():
    """`<mimic>` is refused by either reader, by its line or by MuJoCo's name for it; twin: without it both move."""
    spec = spec_of(COUPLED)
    assert spec.compile().eq_data[0, :2].tolist() == [0.0, 2.0]
    with pytest.raises(ValueError, match="line 6: <mimic> of <joint> 'o' is not supported"):
        lj.read_urdf(COUPLED)
    with pytest.raises(ValueError, match="couples by 'joint', which is not supported"):
        lj.read_mjcf(spec.to_xml())
    free = re.sub("<mimic [^>]*>", "", COUPLED)
    assert len(lj.read_urdf(free).joints) == len(lj.read_mjcf(spec_of(free).to_xml()).joints) == 2


def chain(count):
    """Links in a row."""
    links = "".join(f'<link name="{i}">{BODY}</link>' for i in range(count + 1))
    joint = '<joint name="j{0}" type="revolute"><parent link="{0}"/><child link="{1}"/></joint>'
    return f"<robot name='chain'>{links}{''.join(joint.format(i, i + 1) for i in range(count))}</robot>"


CROSS = two_links(link="", beside=f'<link name="shaft">{BODY}</link><joint name="second" type="revolute">'
                  '<parent link="rod"/><child link="shaft"/><axis xyz="0 1 0"/></joint>')  # fmt: skip
MESH = two_links(link=BODY + '<collision><geometry><mesh filename="hand.stl"/></geometry></collision>')
# What lagjax reads and MuJoCo does not.
REFUSED = {
    "a chain of 1,100 links": chain(1100),
    "the massless cross of a Cardan joint": CROSS,
    "a frame that moves, in joint coordinates": two_links(link=BODY.replace('"1"', '"1e-16"')),
    "a floating joint below a link": two_links(kind="floating"),
    "an axis that is short": two_links('<axis xyz="3e-200 0 4e-200"/>'),
}
# What MuJoCo reads without a word and otherwise than it is written, and lagjax reads as written or refuses by its line.
SILENT = {
    "a misspelt element": (two_links('<orign xyz="1 2 3"/>'), "line 5: <orign>"),
    "a misspelt attribute": (two_links('<origin yaw="1"/>'), "line 5: yaw="),
    "a second root": (two_links(beside='<link name="other"/>'), "no joint holds"),
    "no number": (two_links('<origin xyz="nan 0 0"/>'), "line 5: xyz= of <origin> must be 3 numbers"),
    "a joint tied to none": (two_links('<mimic joint="none"/>'), "line 5: <mimic>"),
    "a quaternion": (two_links('<origin quat_xyzw="0 0 0.6 0.8"/>'), None),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_mujoco_refuses(case):
    """A file that users have today as a model."""
    model = lj.read_urdf(REFUSED[case])
    assert model.links and model.joints
    with pytest.raises(ValueError):
        spec_of(REFUSED[case]).compile()


@pytest.mark.parametrize("case", SILENT)
def test_what_mujoco_reads_otherwise(case, tmp_path, monkeypatch):
    """MuJoCo compiles it as if it were not there; lagjax says so, or has it."""
    # MuJoCo writes its warnings to a file.
    monkeypatch.chdir(tmp_path)
    text, message = SILENT[case]
    m = spec_of(text).compile()
    np.testing.assert_array_equal(m.body("rod").quat, [1.0, 0.0, 0.0, 0.0])
    assert m.neq == 0 and m.njnt == 1
    if message is None:
        axes = lj.read_urdf(text).joints["hinge"].placement.axes
        np.testing.assert_allclose(axes[:2, 0], [0.28, 0.96], atol=1e-15)
    else:
        with pytest.raises(ValueError, match=message):
            lj.read_urdf(text)


def test_what_mujoco_has_not():
    """No lines of elements; products of inertia that may be missing; a mesh that is not there; one planar joint."""
    spec = spec_of(PENDULUM)
    assert {x.info for x in (*spec.bodies, *spec.joints)} == {""}
    assert {x.line for x in lj.read_urdf(PENDULUM).joints.values()} == {"line 12", "line 15"}
    with pytest.raises(ValueError, match="ixy"):
        mujoco.MjSpec.from_string(two_links())
    with pytest.raises(ValueError, match="hand.stl"):
        mujoco.MjSpec.from_string(MESH.replace('izz="1"', 'izz="1" ixy="0" ixz="0" iyz="0"')).compile()
    assert [shape.mesh for shape in lj.read_urdf(MESH).shapes] == ["hand.stl"]
    flat = spec_of(MOVING).compile()
    assert [flat.joint(k).name for k in range(flat.njnt)] == ["r", "p", "f_TX", "f_TY", "f_RZ"]
    # Its slides are along other axes of the plane than the first two vectors of a `lj.bodies.Marker`'s frame.
    ours = lj.bodies.ground.at(axis=(0.6, 0.8, 0.0)).frame
    assert np.abs(np.array(ours[:2]) - flat.jnt_axis[2:4]).max() > 0.1
