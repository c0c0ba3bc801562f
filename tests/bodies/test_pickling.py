"""Systems of bodies in other processes: they are pickled, and copied, with all that acts in them."""

import copy
import pickle
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import lagjax as lj

UP, ACROSS = (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)
FILE = """<robot name="slide"><link name="rail"/><link name="cart"><inertial><mass value="2"/>
<inertia ixx="1" iyy="1" izz="1"/></inertial></link><joint name="s" type="prismatic"><parent link="rail"/>
<child link="cart"/><dynamics damping="0.5"/></joint></robot>"""


def turning(t, params):
    """The motion of a table."""
    return lj.bodies.Pose.at(angle=0.5 * t)


def bowl(r, params):
    """The distance to a sphere, from inside."""
    return 5.0 - jnp.sqrt(jnp.sum(r**2))


def loaded(torque: float = 0.5) -> lj.System:
    """A body on a pivot with a load of each kind."""
    bob, ground = lj.bodies.Body("bob", 1.0, (0.1, 0.2, 0.2)), lj.bodies.ground.at()
    loads = [
        lj.bodies.weight([bob]),
        lj.bodies.spring(lj.bodies.ground.at((1.0, 0.0, 0.0)), bob.at(), 3.0, length=0.5, damping=0.1),
        lj.bodies.torsion(ground, bob.at(), 1.0, angle=0.2, damping=0.3),
        lj.bodies.motor(ground, bob.at(), torque),
        lj.bodies.applied(bob.at(), (0.1, 0.2, 0.3)),
    ]
    return lj.bodies.multibody([bob], {"pivot": lj.bodies.spherical(ground, bob.at(UP))}, loads)


def cases() -> dict:
    """Systems of each kind, with a state of each."""
    ball, table = lj.bodies.Body("ball", 1.0, (0.4, 0.4, 0.4)), lj.bodies.Body("table", motion=turning)
    bob, near, far = (lj.bodies.Pose.at((0.1, 0.2, z), ACROSS, 0.3) for z in (-1.0, 1.0, -4.0))
    arm, hand = (lj.bodies.Body(name, 1.0, (0.1, 0.1, 0.01)) for name in ("arm", "hand"))
    joints = {
        "shoulder": lj.bodies.revolute(lj.bodies.ground.at(axis=ACROSS), arm.at((0.0, 0.0, 0.5), axis=ACROSS)),
        "elbow": lj.bodies.revolute(arm.at((0.0, 0.0, -0.5), axis=ACROSS), hand.at((0.0, 0.0, 0.5), axis=ACROSS)),
    }
    closed = {
        "end": lj.bodies.planar(lj.bodies.ground.at(), hand.at()),
        "rolls": lj.bodies.rolling_sphere(hand.at(), lj.bodies.ground.at(), 1.0),
        "gear": lj.bodies.gear(lj.bodies.ground.at(axis=ACROSS), hand.at(axis=ACROSS), 3.0, carrier=arm),
        "rack": lj.bodies.rack_and_pinion(arm.at(axis=ACROSS), hand.at(), 0.5),
    }
    touching = lj.bodies.rolling_sphere(ball.at(), lj.bodies.ground.at(), 1.0)["touches"].function
    model = lj.read_urdf(FILE)
    still, spun = ({"ball": x.moving((0.3, 0.0, 0.0), (0.1, 0.2, 0.3))} for x in (near, far))
    angles = {"shoulder": jnp.asarray(0.3), "elbow": jnp.asarray(0.1)}
    return {
        "loads": (loaded(), {"bob": bob}, {"bob": bob.moving(spin=(0.1, 0.2, 0.3))}),
        "driven": (
            lj.bodies.multibody([table, ball], lj.bodies.rolling_sphere(ball.at(), table.at(), 1.0)),
            {"ball": near}, still,
        ),
        "surface": (
            lj.bodies.multibody([ball], {"on": lj.bodies.rolling_sphere(ball.at(), lj.bodies.Surface(bowl), 1.0)}),
            {"ball": far}, spun,
        ),
        "contact": (
            lj.bodies.multibody([ball], elements={"floor": lj.Contact(touching, restitution=0.5)}),
            {"ball": near}, still,
        ),
        "tree": (
            lj.bodies.Tree([arm, hand], joints).system(
                [lj.bodies.weight([arm]), lj.bodies.motor(*ends(joints), 0.5)], closed
            ),
            angles, angles,
        ),
        "file": (model.system(), *model.state({"s": 0.5}, {"s": 3.0})),
        "joints of a file": (model.joint_system(), *model.joint_state({"s": 0.5}, {"s": 3.0})),
    }  # fmt: skip


def ends(joints: dict) -> tuple:
    """The two places of the elbow."""
    return joints["elbow"].g.a, joints["elbow"].g.b


def program(system: lj.System, q, v) -> tuple[str, list]:
    """The program of the functions of a system, from which its accelerations follow, with its numbers."""

    def every(q, v):
        found = [system.lagrangian(0.3, q, v, None)]
        found += [c.residual(0.3, q, v, None) for c in system.constraints.values()]
        found += [f(0.3, q, v, None) for f in (system.force, system.dissipation) if f is not None]
        return found + [x.gap(0.3, q, None) for x in (system.elements or {}).values()]

    closed = jax.make_jaxpr(every)(q, v)
    return str(closed.jaxpr), [np.asarray(x).tolist() for x in closed.consts]


IN_ANOTHER = """
import pickle, sys
import jax
jax.config.update("jax_enable_x64", True)
from tests.bodies.test_pickling import program
cases = pickle.load(sys.stdin.buffer)
pickle.dump({name: program(*case) for name, case in cases.items()}, sys.stdout.buffer)
"""


@pytest.mark.slow
def test_in_another_process():
    """Systems of each kind are there the same programs of the same numbers. Twin: not with twice the torque."""
    here = cases()
    ran = subprocess.run([sys.executable, "-c", IN_ANOTHER], input=pickle.dumps(here), capture_output=True, check=True)
    found = pickle.loads(ran.stdout)
    assert found == {name: program(*case) for name, case in here.items()}
    assert found["loads"] != program(loaded(1.0), *here["loads"][1:])


def test_copies():
    """A deep copy is the same system, and one that was pickled draws the same shapes."""
    system = loaded()
    assert copy.deepcopy(system) == system
    shapes, again = (
        getattr(x.lagrangian, "drawing").shapes(None) for x in (system, pickle.loads(pickle.dumps(system)))
    )
    assert [*map(repr, shapes)] == [*map(repr, again)] and len(shapes) > 1
