"""Models from URDF texts, against a double pendulum by hand and MuJoCo; what is refused, by its line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.models.mjcf import mujoco_itself
from tests.jaxtools.in_numpy import accelerations

mujoco = mujoco_itself()

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
    with pytest.raises(ValueError, match="there is no joint 'wrist'.\nFix: one of shoulder, elbow"):
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
        (two_links(kind="ball"), "line 4: type='ball' of <joint> 'hinge' is not supported"),
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
        (two_links(beside=also("rod", "none")), "line 6: <joint> 'x' names a link 'none'"),
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
    with pytest.raises(TypeError, match="takes the path of a file or its text, not int"):
        lj.read_urdf(3)
    with pytest.raises(ValueError, match='base= must be "fixed" or "free"'):
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
