"""Models from MJCF texts, against MuJoCo's own energies and accelerations; what is refused, by its line."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj
from lagjax.bodies import product
from lagjax.models.mjcf import mujoco_itself

mujoco = mujoco_itself()

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
