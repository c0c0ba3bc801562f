"""Models from URDF texts, against a double pendulum by hand and MuJoCo; what is refused, by its line.

Models from MJCF texts, against MuJoCo's own energies and accelerations; what is refused, by its line.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.bodies import product
from lagjax.refusals import installed
from tests.jaxtools.in_numpy import accelerations

mujoco = installed("mujoco", "a test", "models")

G, M1, M2, C1, C2, L1, I1, I2, DAMPING = 9.81, 1.5, 0.8, 0.3, 0.25, 0.6, 0.05, 0.02, 0.2
# The second rod's axes are turned by a quarter turn, so that its hinge is its x axis.
PENDULUM = f"""<?xml version="1.0" encoding="utf-8"?>
<robot name="double pendulum">
  <link name="roof"/>
  <link name="upper">
    <inertial><origin xyz="0 0 -{C1}"/><mass value="{M1}"/><inertia ixx="0.06" iyy="{I1}" izz="0.04"/></inertial>
    <visual><origin xyz="0 0 -0.3" rpy="0 0 1"/><geometry><cylinder radius="0.02" length="0.6"/></geometry></visual>
  </link>
  <link name="lower arm">
    <inertial><origin xyz="0 0 -{C2}"/><mass value="{M2}"/><inertia ixx="{I2}" iyy="0.03" izz="0.04"/></inertial>
    <collision><geometry><mesh filename="package://arm/lower.stl" scale="1 2 3"/></geometry></collision>
  </link>
  <joint name="shoulder" type="continuous">
    <parent link="roof"/><child link="upper"/><axis xyz="0 1 0"/><dynamics damping="{DAMPING}" friction="0.1"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower arm"/><origin xyz="0 0 -{L1}" rpy="0 0 {np.pi / 2!r}"/>
    <axis xyz="2 0 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/>
  </joint>
  <transmission name="drive"/>
</robot>"""


def random_link(name, rng):
    """A link with a turned inertia of some body about a centre off its origin."""
    root = rng.normal(size=(3, 3))
    second = root @ root.T * 0.01
    inertia = np.trace(second) * np.eye(3) - second
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    moments = " ".join(f'{key}="{inertia[place]!r}"' for key, place in names.items()).replace("np.float64", "")
    return (
        f'<link name="{name}"><inertial>{origin(rng, 0.2, 1.0)}<mass value="{rng.uniform(1, 3)}"/>'
        f"<inertia {moments.replace('(', '').replace(')', '')}/></inertial></link>"
    )


def origin(rng, most, turn):
    """An origin at random."""
    xyz, rpy = (" ".join(map(str, rng.uniform(-x, x, 3))) for x in (most, turn))
    return f'<origin xyz="{xyz}" rpy="{rpy}"/>'


def arm():
    """Six joints in a row, a seventh from the second link, a tool fixed to the last; skew axes, turned frames."""
    rng = np.random.default_rng(3)
    parts, rows = ["<robot name='arm'><mujoco><compiler fusestatic='false'/></mujoco><link name='base'/>"], []
    kinds = ["revolute", "continuous", "prismatic", "revolute", "revolute", "revolute"]
    rows += [(f"j{i}", kind, f"l{i - 1}" if i else "base", f"l{i}") for i, kind in enumerate(kinds)]
    rows += [("mount", "fixed", "l5", "tool"), ("side", "revolute", "l1", "fin")]
    for name, kind, parent, child in rows:
        axis = rng.normal(size=3)
        axis = " ".join(map(str, axis / np.sqrt(axis @ axis)))
        parts.append(random_link(child, rng))
        parts.append(
            f'<joint name="{name}" type="{kind}">{origin(rng, 0.5, 2.0)}<parent link="{parent}"/>'
            f'<child link="{child}"/><axis xyz="{axis}"/><limit lower="-3" upper="3" effort="9" velocity="9"/>'
            '<dynamics damping="0.3"/></joint>'
        )
    return "\n".join([*parts, "</robot>"])


def drawn_at_random(model, seed=0):
    """Positions and rates of joints that are numbers."""
    rng = np.random.default_rng(seed)
    return ({name: rng.uniform(-2, 2) for name in model.joints}, {name: rng.normal() for name in model.joints})


def test_a_tree_of_links():
    """Bodies, joints, merged links, shapes and what is left out, as the file has them."""
    model = lj.read_urdf(PENDULUM)
    assert list(model.bodies) == ["upper", "lower arm"] and list(model.joints) == ["shoulder", "elbow"]
    assert [(x.what, x.name, x.line) for x in model.not_taken] == [
        ("<transmission>", "drive", "line 19"),
        ("contacts of <collision>", "lower arm", "line 10"),
        ("dry friction", "shoulder", "line 13"),
        ("limits", "elbow", "line 17"),
        ("length of the axis", "elbow", "line 17"),
    ]
    assert "not taken: dry friction of 'shoulder' (line 13)" in repr(model)
    cylinder, mesh = model.shapes
    assert (cylinder.body, cylinder.kind, cylinder.size, cylinder.role) == ("upper", "cylinder", (0.02, 0.6), "visual")
    np.testing.assert_allclose(cylinder.origin, [0.0, 0.0, C1 - 0.3], atol=1e-15)
    np.testing.assert_allclose(cylinder.axes[:, 0], [np.cos(1), np.sin(1), 0.0], atol=1e-15)
    assert (mesh.mesh, mesh.size) == ("package://arm/lower.stl", (1.0, 2.0, 3.0))
    whole = lj.read_urdf(arm())
    assert "merged: tool into l5" in repr(whole) and len(whole.bodies) == 7
    with pytest.raises(ValueError, match="'wrist', which is no joint; there are 'shoulder' and 'elbow'"):
        model.state({"wrist": 1.0})
    with pytest.raises(ValueError, match=r"rate of 'elbow' must have the shape \(\), not \(2,\)"):
        model.state({"elbow": [1.0, 2.0]})


@pytest.mark.slow
def test_energies_of_an_arm():
    """Mass, T at random states, V and places against MuJoCo's reading of the same file; the way back to angles."""
    text = arm()
    model = lj.read_urdf(text)
    theirs = mujoco.MjModel.from_xml_string(text)
    data = mujoco.MjData(theirs)
    assert abs(sum(body.mass for body in model.bodies.values()) - theirs.body_subtreemass[0]) < 1e-12
    constraints = model.system().constraints
    closing = jax.jit(
        lambda q: {
            name: joint.g(0.0, q, None) for name, joint in constraints.items() if isinstance(joint, lj.Holonomic)
        }
    )
    kinetic_energy = jax.jit(lambda q, v: sum(body.kinetic(q, v) for body in model.bodies.values()))
    for seed in range(3):
        positions, rates = drawn_at_random(model, seed)
        q, v = model.state(positions, rates)
        names = [theirs.joint(i).name for i in range(theirs.njnt)]
        data.qpos[:], data.qvel[:] = ([x[name] for name in names] for x in (positions, rates))
        theirs.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        mujoco.mj_forward(theirs, data)
        np.testing.assert_allclose(kinetic_energy(q, v), data.energy[1], rtol=1e-12)
        height = sum(
            G * np.asarray(body.mass, float) * float(q[name].position[2]) for name, body in model.bodies.items()
        )
        np.testing.assert_allclose(height, data.energy[0], rtol=1e-12)
        for back, given in ((model.joint_positions(q), positions), (model.joint_rates(q, v), rates)):
            np.testing.assert_allclose([back[name] for name in given], list(given.values()), atol=1e-13)
        for name, residual in closing(q).items():
            np.testing.assert_allclose(residual, 0.0, atol=1e-14, err_msg=name)
        tool = model.at("tool", (0.1, 0.2, 0.3))
        in_space = data.body("tool").xpos + data.body("tool").xmat.reshape(3, 3) @ [0.1, 0.2, 0.3]
        np.testing.assert_allclose(tool.position(q), in_space, atol=1e-13)


def pendulum_acceleration(angles, rates, damping=DAMPING):
    """The double pendulum by hand: M a = -(Coriolis) - (weight) - (damper)."""
    (a, b), (u, w) = angles, rates
    m12 = I2 + M2 * (C2**2 + L1 * C2 * np.cos(b))
    m22 = I2 + M2 * C2**2
    m11 = I1 + M1 * C1**2 + I2 + M2 * (L1**2 + C2**2 + 2 * L1 * C2 * np.cos(b))
    bend = M2 * L1 * C2 * np.sin(b)
    of_lower = M2 * G * C2 * np.sin(a + b)
    right = [
        bend * (2 * u * w + w**2) - (M1 * C1 + M2 * L1) * G * np.sin(a) - of_lower - damping * u,
        -bend * u**2 - of_lower,
    ]
    return np.linalg.solve([[m11, m12], [m12, m22]], right)


@pytest.mark.slow
def test_a_double_pendulum_by_hand():
    """Accelerations in both kinds of coordinates, at 1e-12; twin: without the damper they are others."""
    model = lj.read_urdf(PENDULUM)
    angles, rates = {"shoulder": 0.7, "elbow": -1.9}, {"shoulder": 1.1, "elbow": -2.3}
    expected = pendulum_acceleration(list(angles.values()), list(rates.values()))
    assert np.abs(expected - pendulum_acceleration(list(angles.values()), list(rates.values()), 0.0)).max() > 0.1
    a, _ = lj.accelerations(model.joint_system(), 0.0, *model.joint_state(angles, rates), None)
    np.testing.assert_allclose([a["shoulder"], a["elbow"]], expected, atol=1e-12)
    q, v = model.state(angles, rates)
    a, _ = accelerations(model.system(), 0.0, q, v, None)
    turning = jax.jvp(model.joint_rates, (q, v), (v, a))[1]
    np.testing.assert_allclose([turning["shoulder"], turning["elbow"]], expected, atol=1e-12)


BODY = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
LARGEST = BODY.replace('"1"', '"1.7e308"')


def two_links(joint="", link=BODY, kind="revolute", beside=""):
    """A post and a rod, by parts."""
    return (
        f'<robot name="r">\n<link name="post"/>\n<link name="rod">{link}</link>\n'
        f'<joint name="hinge" type="{kind}"><parent link="post"/><child link="rod"/>\n{joint}</joint>\n{beside}</robot>'
    )


def also(parent, child, name="x", inside=""):
    """A further joint."""
    return f'<joint name="{name}" type="fixed"><parent link="{parent}"/><child link="{child}"/>{inside}</joint>'


FAR = '<origin xyz="1.7e308 0 0"/>'


@pytest.mark.parametrize(
    "text, message",
    [
        (two_links(kind="ball"), "line 4: type= of <joint> 'hinge' is 'ball'.* supported; there are 'continuous'"),
        (two_links('<mimic joint="other"/>'), "line 5: <mimic> of <joint> 'hinge' is not supported"),
        (two_links("<orign/>"), "line 5: <orign> in <joint> 'hinge' is not supported"),
        (two_links(beside="<Joint/>"), "line 6: <Joint> in <robot> 'r' is not supported"),
        (two_links('<axis xyz="0 0 0"/>'), "line 5: the axis of <joint> 'hinge' is zero"),
        (two_links('<axis xyz="0 0"/>'), "line 5: xyz= of <axis> must be 3 numbers, and is '0 0'"),
        (two_links('<origin xyz="${x} 0 0"/>'), "line 5: xyz= of <origin> must be 3 numbers"),
        (two_links('<origin xyz="nan 0 0"/>'), "line 5: xyz= of <origin> must be 3 numbers"),
        (two_links('<origin yaw="1"/>'), "line 5: yaw= of <origin> is not supported"),
        (two_links("<axis/>"), "line 5: <axis> has no xyz="),
        (two_links(link='<inertial><mass value="1"/></inertial>'), "line 3: <inertial> has no <inertia>"),
        (two_links(link=BODY + BODY), "line 3: <link> has a second <inertial>"),
        (two_links(link=BODY.replace('ixx="1"', 'ixx="3"')), "line 3: 'rod' has the principal moments 1, 1, 3"),
        (two_links(link=BODY.replace("mass value=", "mass kg=")), "line 3: <mass> has no value="),
        (two_links(link=BODY.replace('mass value="1"', 'mass value="-1"')), "line 3: 'rod' has the mass -1"),
        (two_links(link=BODY.replace('mass value="1"', 'mass value="0"')), "line 3: 'rod' has moments of .* no mass"),
        (
            two_links(link=LARGEST, beside=f'<link name="hand">{LARGEST}</link>' + also("rod", "hand")),
            "line 3: .* of 'rod', with what is fixed to it, are beyond the largest number",
        ),
        (
            two_links(
                '<origin xyz="1.7e308 0 0"/>',
                beside='<link name="palm"/><link name="tip"/>'
                + also("post", "palm", "x", FAR)
                + "\n"
                + also("palm", "tip", "y", FAR)
                + f'<link name="end">{BODY}</link>'
                + also("tip", "end", "grip").replace("fixed", "revolute"),
            ),
            "line 7: .* place of 'grip', with what is fixed to it, are beyond the largest number",
        ),
        (two_links('<origin quat_xyzw="0 0 0 0"/>'), "line 5: quat_xyzw= of <origin> is zero"),
        (two_links(beside='<link name="other"/>'), "no joint holds 'post' .line 2., 'other' .line 6."),
        (two_links(beside='<link name="rod"/>'), "line 6: <link> 'rod' is there already, in line 3"),
        (two_links(beside=also("post", "rod")), "line 6: 'rod' is the child of 'x' and of 'hinge' .line 4."),
        (two_links(beside=also("rod", "post")), "joints go in a circle, and no link is the root"),
        (two_links(beside=also("rod", "none")), "line 6: <joint> 'x' names 'none', which is no link"),
        (two_links(beside=also("rod", "rod")), "line 6: <joint> 'x' joins 'rod' to itself"),
        (
            two_links(beside='<link name="a"/><link name="b"/>' + also("a", "b") + also("b", "a", "y")),
            "in a circle that nothing joins to the root: 'x' .line 6., 'y'",
        ),
        ("<robot name='r'/>", "there is no <link>"),
        ("\n\n<robot name='r'><link name='a'/></robot>", "nothing in 'r' moves.*\n.*\nFix: .*base=\"free\""),
        ("\n <?xml version='1.0'?>\n<robot name='r'>\n<links/></robot>", "line 4: <links> in <robot> 'r'"),
        ("<mujoco/>", "URDF begins with <robot>, and this with <mujoco>.\nFix: lj.read_mjcf"),
        ("<robot><link name='a'></robot>", "the text is not XML: mismatched tag: line 1"),
        (
            "<robot xmlns:xacro='http://wiki.ros.org/xacro'>\n<xacro:arm/></robot>",
            "line 2 of the text: <xacro:arm> is a macro.*\nFix: xacro robot.urdf.xacro",
        ),
    ],
)
def test_what_is_refused(text, message):
    """Each with its line and name."""
    with pytest.raises(ValueError, match=message):
        lj.read_urdf(text)


@pytest.mark.parametrize(("axis", "unit"), [("0 1e200 0", [0, 1, 0]), ("3e-200 0 4e-200", [0.6, 0, 0.8])])
def test_axes_of_any_length(axis, unit):
    """An axis is a direction, however long it is written; moments of inertia may be the largest numbers."""
    model = lj.read_urdf(two_links(f'<axis xyz="{axis}"/>', link=BODY.replace('"1"', '"1e308"')))
    np.testing.assert_allclose(model.joints["hinge"].axis, unit, rtol=1e-15)
    assert model.bodies["rod"].mass == 1e308


def test_a_long_chain():
    """A thousand links are read, and are a tree, though Python's calls are not so deep."""
    links = "".join(f'<link name="{i}">{BODY}</link>' for i in range(1001))
    joint = '<joint name="{0}" type="revolute"><parent link="{0}"/><child link="{1}"/></joint>'
    model = lj.read_urdf(f"<robot>{links}{''.join(joint.format(i, i + 1) for i in reversed(range(1000)))}</robot>")
    assert [joint.name for joint in model.joints.values()] == [str(i) for i in range(1000)]
    model.tree()


def test_files_and_texts(tmp_path):
    """A path as text or Path, a text with its declaration; what is neither."""
    path = tmp_path / "two links.urdf"
    path.write_text(PENDULUM)
    assert repr(lj.read_urdf(path)) == repr(lj.read_urdf(str(path))) == repr(lj.read_urdf(PENDULUM))
    path.write_bytes(b"\xef\xbb\xbf" + PENDULUM.encode())
    assert repr(lj.read_urdf(path)) == repr(lj.read_urdf("\ufeff" + PENDULUM)) == repr(lj.read_urdf(PENDULUM))
    with pytest.raises(FileNotFoundError, match="there is no file 'xxx.*[.][.][.]'"):
        lj.read_urdf(5000 * "x")
    with pytest.raises(FileNotFoundError, match="there is no file 'nowhere.urdf'"):
        lj.read_urdf("nowhere.urdf")
    for name in ("a\0b", "\udc80"):
        with pytest.raises(FileNotFoundError, match="there is no file"):
            lj.read_urdf(name)
    for read, text in ((lj.read_urdf, PENDULUM), (lj.read_mjcf, "<mujoco>\n<worldbody/></mujoco>")):
        with pytest.raises(ValueError, match=r"line 2 of the text has the character '\\udc80', which no file can have"):
            read(text.replace("\n", "\n\udc80", 1))
    with pytest.raises(TypeError, match="takes the path of a file or its text, not 3"):
        lj.read_urdf(3)
    with pytest.raises(ValueError, match="base must be .fixed. or .free."):
        lj.read_urdf(PENDULUM, base="flying")


def test_massless_links():
    """Without mass a link is a frame: one that moves is refused by its line, but as the cross of a Cardan joint."""
    text = two_links(link="")
    model = lj.read_urdf(text)
    for system in (model.system, model.joint_system):
        with pytest.raises(ValueError, match="line 3: the link 'rod' moves and has no mass, by 'hinge' .revolute."):
            system()

    def with_a_shaft(axis):
        second = '<joint name="second" type="revolute"><parent link="rod"/><child link="shaft"/>'
        beside = f'<link name="shaft">{BODY}</link>{second}<axis xyz="{axis}"/></joint>'
        return lj.read_urdf(two_links(link="", beside=beside))

    cross = with_a_shaft("0 1 0")
    assert list(cross.system().constraints) == ["hinge second", "shaft is turned"]
    joint = cross.system().constraints["hinge second"]
    assert isinstance(joint, lj.Holonomic) and joint.g(0.0, cross.state()[0], None).shape == (4,)
    skew = with_a_shaft("1 1 0")
    with pytest.raises(ValueError, match="(?s)'hinge' .revolute., 'second' .revolute.*model.joint_system"):
        skew.system()
    with pytest.raises(ValueError, match="joint 'hinge' has a massless link at one end"):
        cross.markers("hinge")


def test_a_free_base():
    """The root flies: its pose goes by its name, in space, and a joint leads on from it."""
    text = two_links().replace('<link name="post"/>', f'<link name="post">{BODY}</link>')
    model = lj.read_urdf(text, base="free")
    assert model.joints["post"].kind == "floating" and list(model.bodies) == ["post", "rod"]
    pose = lj.bodies.Pose.at((1.0, 2.0, 3.0), (0.0, 0.0, 1.0), np.pi / 2)
    q, v = model.state({"post": pose}, {"post": pose.moving((1.0, 0.0, 0.0))})
    np.testing.assert_allclose(q["rod"].position, [1.0, 2.0, 3.0], atol=1e-15)
    np.testing.assert_allclose(v["rod"].position, [1.0, 0.0, 0.0], atol=1e-15)
    assert jnp.all(model.joint_positions(q)["post"].quaternion == pose.quaternion)
    assert list(model.system().constraints) == ["hinge", "post is turned", "rod is turned"]


# Two arms' worth of what MJCF has: degrees, defaults, several joints of a body, places of joints, references of angles,
# springs, rotors, a body without a joint, inertias from shapes.
TEXT = """<mujoco model="parts">
 <compiler angle="degree"/>
 <default><joint damping="0.2" armature="0.03"/>
  <default class="stiff"><joint stiffness="3" springref="20"/></default></default>
 <worldbody>
  <body name="trunk" pos="0.1 0.2 1" euler="10 20 30">
   <joint name="yaw" axis="0 0 1" pos="0.05 0 0" ref="15"/>
   <geom type="box" size=".1 .2 .3" pos=".05 0 0.02" euler="5 0 10"/>
   <body name="plate" pos="0 0 0.3" euler="0 30 0">
    <geom type="cylinder" size=".1 .02" pos="0.1 0 0"/>
    <body name="upper" pos="0.2 0 0.1" euler="40 0 0">
     <joint name="first" axis="1 0 0" pos="0 0.02 0"/><joint name="second" axis="0 1 0" pos="0 0.02 0" class="stiff"/>
     <geom type="capsule" fromto="0 0 0 0.1 0.1 -0.5" size=".05"/>
     <body name="fore" pos="0.1 0.1 -0.5">
      <joint name="slide" type="slide" axis="1 1 0" class="stiff" range="-1 1" frictionloss="0.1"/>
      <geom type="ellipsoid" size=".1 .2 .15" pos=".1 0 0"/>
      <body name="hand" pos="0.1 0 -.3"><joint name="ball" type="ball" pos="0 0 0.1"/>
       <geom type="box" size=".1 .05 .02"/></body>
     </body>
    </body>
   </body>
  </body>
  <body name="crate" pos="2 0 1" euler="0 0 45"><freejoint name="fly"/>
   <geom type="box" size=".1 .2 .3" pos="0.1 0 0"/></body>
  <body name="cart" pos="3 0 0"><joint type="slide" axis="1 0 0" name="x"/><joint type="slide" axis="0 1 0" name="y"/>
   <joint axis="0 0 1" name="turn" pos=".1 0 0"/><geom type="box" size=".1 .2 .3"/></body>
 </worldbody>
 <actuator><motor name="drive" joint="yaw"/></actuator>
</mujoco>"""


def residuals(system, q):
    """What is left of each constraint on positions."""
    return jax.jit(lambda q: {name: x.g(0.0, q, None) for name, x in system.constraints.items()})(q)


class Theirs:
    """The same file in MuJoCo, in a state at random, and this state by joints' names as here."""

    def __init__(self, text, seed=1):
        self.m = mujoco.MjModel.from_xml_string(text)
        self.data = mujoco.MjData(self.m)
        self.m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.m.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
        self.m.dof_frictionloss[:] = 0.0
        self.m.jnt_limited[:] = 0
        rng, self.positions, self.rates = np.random.default_rng(seed), {}, {}
        for k in range(self.m.njnt):
            name, at, first = self.m.joint(k).name, self.m.jnt_qposadr[k], self.m.jnt_dofadr[k]
            spin, velocity = rng.normal(size=3), rng.normal(size=3)
            if self.m.jnt_type[k] == mujoco.mjtJoint.mjJNT_BALL:
                e = lj.bodies.Pose.at(axis=rng.normal(size=3), angle=1.2).quaternion
                self.positions[name], self.data.qpos[at : at + 4] = e, e
                self.rates[name] = product(e, jnp.concatenate([jnp.zeros(1), jnp.asarray(spin)])) / 2
                self.data.qvel[first : first + 3] = spin
            elif self.m.jnt_type[k] == mujoco.mjtJoint.mjJNT_FREE:
                # MuJoCo counts from the body's frame, and its spin along the body's axes.
                pose, name = (
                    lj.bodies.Pose.at(rng.normal(size=3), rng.normal(size=3), 0.8),
                    self.m.body(self.m.jnt_bodyid[k]).name,
                )
                self.positions[name], self.rates[name] = pose, pose.moving(velocity, spin)
                body = lj.bodies.Body(name, 1.0, (1.0, 1.0, 1.0))
                q = {name: pose}
                arm = -body.direction(q, self.m.body(name).ipos)
                self.data.qpos[at : at + 7] = np.concatenate([pose.position + arm, pose.quaternion])
                turned = body.spin_in_body(q, {name: self.rates[name]})
                self.data.qvel[first : first + 6] = np.concatenate([velocity + np.cross(spin, arm), turned])
            else:
                self.positions[name], self.rates[name] = rng.uniform(-1, 1), spin[0]
                self.data.qpos[at] = self.m.qpos0[at] + self.positions[name]
                self.data.qvel[first] = spin[0]
        mujoco.mj_forward(self.m, self.data)


@pytest.mark.slow
def test_energies_and_places():
    """T and V of a state at random, centres of mass and the way back to joints, against MuJoCo. Twin: another ref."""
    model, theirs = lj.read_mjcf(TEXT), Theirs(TEXT)
    q, v = model.state(theirs.positions, theirs.rates)
    for name in ("trunk", "plate", "upper", "hand", "crate", "cart"):
        np.testing.assert_allclose(model.at(name).position(q), theirs.data.body(name).xpos, atol=1e-14)
    back, rates = model.joint_positions(q), model.joint_rates(q, v)
    for name in model.joints:
        for ours, given in ((back, theirs.positions), (rates, theirs.rates)):
            for x, y in zip(jax.tree.leaves(ours[name]), jax.tree.leaves(given[name])):
                np.testing.assert_allclose(x, y, atol=1e-14, err_msg=name)
    state = model.joint_state(theirs.positions, theirs.rates)
    expected = theirs.data.energy[1] - theirs.data.energy[0]
    loss = np.sum(theirs.m.dof_damping * theirs.data.qvel**2) / 2
    for system, at in ((model.joint_system(), state), (model.system(), (q, v))):
        both = jax.jit(
            lambda *at: [f(0.0, *at, None) for f in (system.lagrangian, system.dissipation) if f is not None]
        )(*at)
        np.testing.assert_allclose(both, [expected, loss], rtol=1e-13)
    for name, residual in residuals(model.system(), q).items():
        np.testing.assert_allclose(residual, 0.0, atol=1e-14, err_msg=name)
    moved = lj.read_mjcf(TEXT.replace('springref="20"', 'springref="10"'))
    assert abs(float(jax.jit(moved.joint_system().lagrangian)(0.0, *state, None)) - expected) > 0.01


def test_what_is_taken_and_what_is_not():
    """Combined joints, shapes in one convention, and the list of the rest with its lines."""
    model = lj.read_mjcf(TEXT)
    names = [name for name in model.system().constraints if not name.endswith("turned")]
    assert sorted(names) == ["ball", "first second", "slide", "x y turn", "yaw"]
    listed = {(x.what, x.name, x.line) for x in model.not_taken if x.what != "contacts"}
    assert listed == {
        ("limits", "slide", "line 15"), ("dry friction", "slide", "line 15"), ("actuators", "drive", "line 28"),
    }  # fmt: skip
    assert "merged: plate into trunk" in repr(model)
    sizes = {shape.link: (shape.kind, shape.size, shape.role) for shape in model.shapes}
    assert sizes["trunk"] == ("box", (0.2, 0.4, 0.6), "both") and sizes["plate"] == ("cylinder", (0.1, 0.04), "both")
    centre = model.links["trunk"].centre
    np.testing.assert_allclose(model.shapes[0].origin + centre, [0.0, 0.0, 0.02], atol=1e-15)


LOOP = """<mujoco>
 <worldbody>
  <body name="crank" pos="0 0 1"><joint axis="0 1 0"/><geom type="box" size=".1 .1 .1"/>
   <body name="rod" pos="1 0 0"><joint axis="0 1 0"/><geom type="box" size=".1 .1 .1" pos="1 0 0"/></body></body>
  <body name="slider" pos="3 0 1"><joint type="slide" axis="1 0 0"/><geom type="box" size=".1 .1 .1"/>
   <site name="s" pos="0 0 0.2"/></body>
  <body name="lid" pos="3 0 2" euler="0 90 0"><freejoint/><geom type="box" size=".1 .1 .1"/></body>
 </worldbody>
 <equality>
  <connect name="pin" body1="rod" body2="slider" anchor="2 0 0"/>
  <weld name="glue" body1="slider" body2="lid" anchor="0 0.1 0"/>
  {}
 </equality>
</mujoco>"""


@pytest.mark.slow
def test_loops():
    """`connect` and `weld` hold as drawn, and not once the crank is turned; a coupling of joints is refused."""
    model = lj.read_mjcf(LOOP.format(""))
    assert [(loop.name, loop.kind) for loop in model.loops] == [("pin", "spherical"), ("glue", "fixed")]
    of_poses = model.system()
    for moved, wrong in (({}, False), ({"joint 0": 0.3}, True)):
        left = residuals(of_poses, model.state(moved)[0])
        assert (np.abs(left["pin"]).max() > 0.1) == wrong
        np.testing.assert_allclose(left["glue"], 0.0, atol=1e-14)
    # The same with positions of joints that close it: the rod is 2 long, the crank 1.
    crank = 0.4
    rod = -np.arcsin(np.sin(crank) / 2) - crank
    slide = np.cos(crank) + 2 * np.cos(crank + rod) - 3
    lid = lj.bodies.Pose.at((3.0 + slide, 0.0, 2.0), (0.0, 1.0, 0.0), np.pi / 2)
    positions = {"joint 0": crank, "joint 1": rod, "joint 2": slide, "lid": lid}
    for name, residual in residuals(model.joint_system(), model.joint_state(positions)[0]).items():
        np.testing.assert_allclose(residual, 0.0, atol=1e-14, err_msg=name)
    with pytest.raises(ValueError, match="line 12: the equality 'gear' couples by 'joint', which is not supported"):
        lj.read_mjcf(LOOP.format('<joint name="gear" joint1="a" joint2="b"/>').replace(
            '<joint axis', '<joint name="a" axis', 1).replace('<joint type', '<joint name="b" type'))  # fmt: skip


def test_files(tmp_path):
    """`<include>` is MuJoCo's work; what it refuses is told in its words; a file that is not there."""
    part, whole = tmp_path / "part.xml", tmp_path / "whole.xml"
    part.write_text('<mujoco><body name="b"><joint type="ball"/><geom type="sphere" size="1"/></body></mujoco>')
    whole.write_text('<mujoco><worldbody><include file="part.xml"/></worldbody></mujoco>')
    assert list(lj.read_mjcf(whole).bodies) == ["b"]
    assert list(lj.read_mjcf("\ufeff" + part.read_text().replace("<body", "<worldbody><body").replace(
        "</body>", "</body></worldbody>")).bodies) == ["b"]  # fmt: skip
    with pytest.raises(ValueError, match="(?s)MuJoCo does not take the text: .*bdy.*line 2"):
        lj.read_mjcf("<mujoco><worldbody>\n<bdy/></worldbody></mujoco>")
    with pytest.raises(FileNotFoundError, match="there is no file 'nowhere.xml'"):
        lj.read_mjcf("nowhere.xml")


def test_a_loop_that_is_nowhere():
    """An anchor that is no finite number is refused by line and name."""
    with pytest.raises(ValueError, match="line 10: .* place of 'pin', .* are beyond the largest number"):
        lj.read_mjcf(LOOP.format("").replace('anchor="2 0 0"', 'anchor="inf 0 0"'))


def welded_beside(name):
    """A body with another of mass 5 welded to it, which has no name, and a second body of this name."""
    return f"""<mujoco><worldbody><body name="a"><joint name="h" axis="0 1 0"/><geom size=".1" mass="1"/>
        <body><geom size=".1" mass="5"/></body></body>
        <body name="{name}"><joint axis="0 1 0"/><joint name="k"/><geom size=".1" mass="1"/></body></worldbody>
        <equality><connect name="h" body1="{name}" body2="world" anchor="0 0 0"/></equality></mujoco>"""


@pytest.mark.parametrize("name", ["body 2", "body 2'", "a before k", "body 3 before k", "joint 1", "h", "equality h"])
def test_made_up_names_meet_none_of_the_file(name):
    """Whatever a body is called, masses and joints are those of the file, and a loop takes no joint's place."""
    model = lj.read_mjcf(welded_beside(name))
    assert {key: body.mass for key, body in model.bodies.items()} == {"a": 6.0, name: 1.0}
    assert [joint.parent for joint in model.joints.values()][:2] == [None, None] and len(model.joints) == 3
    assert len({*model.joints, *(loop.name for loop in model.loops)}) == 4


@pytest.mark.parametrize(
    ("attributes", "axis", "message"),
    [
        ('quat="0 0 0 0"', "0 1 0", "MuJoCo does not take the text: .*zero quaternion"),
        ('quat="1e200 0 0 1e200"', "0 1 0", "line 1: place, mass or inertia of 'rod' are no finite numbers"),
        ('pos="nan 0 0"', "0 1 0", "line 1: place, mass or inertia of 'rod' are no finite numbers"),
        pytest.param("", "0 1e200 0", "line 1: the axis of 'hinge' has no direction",
                     marks=pytest.mark.filterwarnings("ignore:Inertia matrix is too close")),
    ],
)  # fmt: skip
def test_numbers_that_are_none(attributes, axis, message, tmp_path, monkeypatch):
    """Refused with line and name."""
    # MuJoCo writes its warnings to a file.
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        lj.read_mjcf(
            f'<mujoco><worldbody><body name="rod" {attributes}><joint name="hinge" axis="{axis}"/>'
            '<geom size=".1" mass="1"/></body></worldbody></mujoco>'
        )
