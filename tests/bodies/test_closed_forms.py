"""Motions of bodies against closed forms: tops by elliptic functions, disks by Appell's equations, a closed chain."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp
from scipy.special import ellipj, ellipk

import lagjax as lj

G = 9.81


def residual(system, motion):
    """How far a motion is from its constraints, at most."""
    each = jax.vmap(lambda q, v: lj.constraint_residual(system, 0.0, q, v, None))(motion.q, motion.v)
    return max(float(jnp.abs(x).max()) for x in each.values())


def along(motion, body, vector=(0.0, 0.0, 1.0)):
    """A direction of a body at all outputs, (T, 3)."""
    return np.asarray(jax.vmap(lambda q: body.direction(q, vector))(motion.q))


@pytest.mark.exhaustive
def test_a_free_body(tmp_path):
    """Ω of a tumbling body over 100 turns, and near the middle axis, by Jacobi's functions; its L in space stays.

    Landau & Lifshitz, *Mechanics*, §37. Near the middle axis the body flips at intervals of 2 K(k) over the rate, as
    Dzhanibekov's nut: Ω about the middle axis of the sphere vanishes there, and 1 - k² = 8e-4 amplifies errors.
    """
    i1, i2, i3 = moments = np.array([1.0, 2.0, 3.0])
    body, pose = lj.bodies.Body("b", 1.0, tuple(moments)), lj.bodies.Pose.at()
    system = lj.bodies.multibody([body])

    def motion(spin, ts):
        return lj.integrate(
            system, {"b": pose}, {"b": pose.moving(spin=spin)}, None, ts=ts, rtol=1e-13, estimate_error=False
        )

    def largest(start):
        """The largest values of Ω, its rate and k², with 2E I2 < L²."""
        energy, squared = np.sum(moments * start**2), np.sum((moments * start) ** 2)
        assert squared > energy * i2
        rate = np.sqrt((i3 - i2) * (squared - energy * i1) / (i1 * i2 * i3))
        k2 = (i2 - i1) * (energy * i3 - squared) / ((i3 - i2) * (squared - energy * i1))
        return np.sqrt([(energy * i3 - squared) / (i1 * (i3 - i1)), (energy * i3 - squared) / (i2 * (i3 - i2)),
                        (squared - energy * i1) / (i3 * (i3 - i1))]), rate, k2  # fmt: skip

    start = np.array([0.6, 0.0, 0.9])
    size, rate, k2 = largest(start)
    ts = np.linspace(0.0, 100.3 * 4 * ellipk(k2) / rate, 201)
    tumbling = motion(start, ts)
    sn, cn, dn, _ = ellipj(rate * ts, k2)
    spins = np.asarray(jax.vmap(body.spin_in_body)(tumbling.q, tumbling.v))
    np.testing.assert_allclose(spins, size * np.stack([cn, sn, dn], axis=1), atol=1e-10)
    assert np.abs(spins - size * np.stack([cn, -sn, dn], axis=1)).max() > 0.1
    momenta = np.asarray(jax.vmap(body.angular_momentum)(tumbling.q, tumbling.v))
    np.testing.assert_allclose(momenta, np.broadcast_to(moments * start, momenta.shape), atol=1e-11)
    np.testing.assert_allclose(jnp.sum(tumbling.q["b"].quaternion ** 2, axis=1), 1.0, atol=1e-14)
    tumbling.save(tmp_path / "motion.npz")
    again = lj.load_trajectory(tmp_path / "motion.npz", system)
    np.testing.assert_array_equal(again.q["b"].quaternion, tumbling.q["b"].quaternion)

    # As many outputs as above, so that nothing is compiled again: ten flips, and times between them.
    size, rate, k2 = largest(np.array([0.02, 1.0, 0.02]))
    flips = np.arange(201) / 20 * 2 * ellipk(k2) / rate
    flipping = motion(np.array([size[0], 0.0, size[2]]), flips)
    spins = np.asarray(jax.vmap(body.spin_in_body)(flipping.q, flipping.v))[::20]
    np.testing.assert_allclose(spins[:, 1] / (size[1] * rate), 0.0, atol=1e-8)
    np.testing.assert_allclose(spins[:, 0], size[0] * (-1.0) ** np.arange(11), atol=1e-8)


def top_on_its_tip():
    """A symmetric top of moments A about the tip and C about its axis; its state by tilt, spin about it and turn."""
    mass, length, across, C = 1.0, 0.5, 0.1, 0.05
    top = lj.bodies.Body("top", mass, (across, across, C))
    tip = lj.bodies.spherical(lj.bodies.ground.at(), top.at((0.0, 0.0, -length)))
    system = lj.bodies.multibody([top], {"tip": tip}, [lj.bodies.weight([top])])

    def state(tilt, own, turn):
        pose = lj.bodies.Pose.at(axis=(1.0, 0.0, 0.0), angle=tilt)
        axis = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
        spin = own * axis + turn * np.array([0.0, 0.0, 1.0])
        pose = pose._replace(position=jnp.asarray(length * axis))
        return {"top": pose}, {"top": pose.moving(np.cross(spin, length * axis), spin)}

    return top, system, state, (across + mass * length**2, C, mass * G * length)


@pytest.mark.exhaustive
def test_a_heavy_top():
    """Nutation cos θ = u1 + (u2 - u1) sn² and precession by its quadrature; regular precession turns evenly.

    Goldstein, §5.7: with u = cos θ, u'² = (1 - u²)(α - β u) - (b - a u)², φ' = (b - a u)/(1 - u²).
    """
    top, system, state, (A, C, weight) = top_on_its_tip()
    tilt, own = 0.7, 60.0
    a = C * own / A
    b, beta = a * np.cos(tilt), 2 * weight / A
    cubic = np.poly1d([-1.0, 0.0, 1.0]) * np.poly1d([-beta, beta * np.cos(tilt)]) - np.poly1d([-a, b]) ** 2
    u1, u2, u3 = np.sort(np.real(cubic.roots))
    k2, rate = (u2 - u1) / (u3 - u1), np.sqrt(beta * (u3 - u1)) / 2
    period = 2 * ellipk(k2) / rate
    np.testing.assert_allclose(u2, np.cos(tilt), atol=1e-12)

    def height(t):
        # The top starts at its highest, at rest but for its spin.
        return u1 + (u2 - u1) * ellipj(rate * t + ellipk(k2), k2)[0] ** 2

    def turned(t):
        whole, part = divmod(t, period)
        up_to = [quad(lambda s: (b - a * height(s)) / (1 - height(s) ** 2), 0.0, end, epsabs=1e-12)[0]
                 for end in (period, part)]  # fmt: skip
        return whole * up_to[0] + up_to[1]

    ts = np.linspace(0.0, 20.3 * period, 41)
    q, v = state(tilt, own, 0.0)
    motion = lj.integrate(system, q, v, None, ts=ts, rtol=1e-12, estimate_error=False)
    axis = along(motion, top)
    np.testing.assert_allclose(axis[:, 2], height(ts), atol=5e-10)
    assert np.abs(axis[:, 2] - (u1 + (u2 - u1) * np.cos(np.pi * ts / period) ** 2)).max() > 1e-3
    azimuth = np.unwrap(np.arctan2(axis[:, 1], axis[:, 0])) + np.pi / 2
    np.testing.assert_allclose(azimuth, [turned(t) for t in ts], atol=2e-9)
    assert residual(system, motion) < 1e-12

    # C ω3 Ω = m g l + A Ω² cos θ: the axis goes round at Ω without nodding.
    turn = 2.0
    about_axis = (weight + A * turn**2 * np.cos(tilt)) / (C * turn)
    ts = np.linspace(0.0, 20 * np.pi, 41)
    for spin, nods in ((about_axis, False), (weight / (C * turn), True)):
        q, v = state(tilt, spin - turn * np.cos(tilt), turn)
        axis = along(lj.integrate(system, q, v, None, ts=ts, rtol=1e-12, estimate_error=False), top)
        even = np.stack([np.sin(tilt) * np.sin(turn * ts), -np.sin(tilt) * np.cos(turn * ts)], axis=1)
        assert bool(np.abs(axis[:, :2] - even).max() > 1e-2) == nods
        if not nods:
            np.testing.assert_allclose(axis[:, :2], even, atol=2e-8)
            np.testing.assert_allclose(axis[:, 2], np.cos(tilt), atol=2e-8)


@pytest.mark.exhaustive
def test_a_rolling_disk():
    """A disk that rolls in a circle, and one that wobbles: ω3 and ω_e are functions of the tilt, and energy stays.

    With the axis a at α from the vertical, the way up e in the disk and moments A and C, Euler's and Newton's
    equations in the frame (a, e, a × e), which goes round with the tilt, leave Appell's pair,

        dω3/dα = m R²/(C + m R²) ω_e,      dω_e/dα = (C/A) ω3 - ω_e cot α

    and a steady circle with (C + m R²) ω3 Ω sin α = A Ω² sin α cos α - m g R cos α.
    Bloch, *Nonholonomic Mechanics and Control*, §1.4; Neimark & Fufaev, *Dynamics of Nonholonomic Systems*.
    """
    m, R = 1.0, 0.4
    A, C = m * R**2 / 4, m * R**2 / 2
    disk = lj.bodies.Body("disk", m, (A, A, C))
    system = lj.bodies.multibody(
        [disk], {"rim": lj.bodies.rolling(disk.at(), lj.bodies.ground.at(), R)}, [lj.bodies.weight([disk])]
    )

    def state(tilt, w3, we, falling):
        axis, up = np.array([np.sin(tilt), 0.0, np.cos(tilt)]), np.array([-np.cos(tilt), 0.0, np.sin(tilt)])
        spin = w3 * axis + we * up - falling * np.cross(axis, up)
        pose = lj.bodies.Pose.at(R * up, (0.0, 1.0, 0.0), tilt)
        return {"disk": pose}, {"disk": pose.moving(np.cross(spin, R * up), spin)}

    def motion(start, end):
        q, v = start
        return lj.integrate(system, q, v, None, ts=np.linspace(0.0, end, 61), rtol=1e-12, estimate_error=False)

    tilt, turn = 1.1, 3.0
    w3 = np.cos(tilt) * (A * turn**2 * np.sin(tilt) - m * G * R) / ((C + m * R**2) * turn * np.sin(tilt))
    for spin, is_steady in ((w3, True), (0.9 * w3, False)):
        start = state(tilt, spin, turn * np.sin(tilt), 0.0)
        circle = motion(start, 20 * 2 * np.pi / turn)
        centre = np.asarray(circle.q["disk"].position) - [-R * np.cos(tilt) + R * w3 / turn, 0.0, 0.0]
        angle = turn * np.asarray(circle.t)
        radius = -R * w3 / turn
        expected = np.stack([radius * np.cos(angle), radius * np.sin(angle), R * np.sin(tilt) + 0 * angle], axis=1)
        assert bool(np.abs(centre - expected).max() < 1e-10) == is_steady

    wobble = motion(state(0.9, 4.0, 1.5, 0.7), 10.0)
    axis, spin = along(wobble, disk), np.asarray(jax.vmap(disk.spin)(wobble.q, wobble.v))
    tilts = np.arccos(axis[:, 2])
    up = (np.array([0.0, 0.0, 1.0]) - axis[:, 2:] * axis) / np.sin(tilts)[:, None]
    assert np.ptp(tilts) > 0.5
    for factor in (1.0, 0.99):

        def rates(tilt, w, factor=factor):
            return [m * R**2 / (C + m * R**2) * w[1], factor * C / A * w[0] - w[1] / np.tan(tilt)]

        accurate = {"method": "DOP853", "rtol": 1e-13, "atol": 1e-13, "dense_output": True}
        ends = tilts.min() - 1e-3, tilts.max() + 1e-3
        parts = [solve_ivp(rates, (0.9, end), [4.0, 1.5], **accurate).sol for end in ends]
        exact = np.array([parts[int(tilt > 0.9)](tilt) for tilt in tilts])
        off = np.abs(np.stack([np.sum(spin * axis, axis=1), np.sum(spin * up, axis=1)], axis=1) - exact).max()
        assert off < 2e-11 if factor == 1.0 else off > 1e-3
    energy = np.asarray(wobble.jacobi_integral())
    np.testing.assert_allclose(energy, energy[0], rtol=1e-11)
    assert residual(system, wobble) < 1e-12


INERTIA = "0.3 0.4 0.5 0.05 -0.04 0.03"
MODEL = """
<mujoco>
  <option gravity="0 0 -9.81"><flag contact="disable"/></option>
  <worldbody>{}</worldbody>
</mujoco>
"""


@pytest.mark.exhaustive
def test_a_chain_in_space_beside_mujoco():
    """Five links with hinges askew: accelerations of centres and spins are MuJoCo's, which has joint angles."""
    mujoco = pytest.importorskip("mujoco")
    random = np.random.default_rng(5)
    inside = ""
    for _ in range(5):
        numbers = {"pos": random.normal(size=3), "axis": random.normal(size=3), "com": random.normal(size=3) / 3}
        written = {name: " ".join(map(str, x)) for name, x in numbers.items()}
        inside = (
            f'<body pos="{written["pos"]}"><joint type="hinge" axis="{written["axis"]}"/>'
            f'<inertial pos="{written["com"]}" mass="{random.uniform(0.5, 2.0)}" fullinertia="{INERTIA}"/>'
            f"{inside}</body>"
        )
    model = mujoco.MjModel.from_xml_string(MODEL.format(inside))
    data = mujoco.MjData(model)
    data.qpos, data.qvel = random.normal(size=5), random.normal(size=5)
    mujoco.mj_forward(model, data)

    bodies, joints, q, v, expected = [], {}, {}, {}, {}
    parent, rotation, centre = lj.bodies.ground, np.eye(3), np.zeros(3)
    for i in range(1, 6):
        anchor, axis = data.xanchor[i - 1], data.xaxis[i - 1]
        before = parent.at(rotation.T @ (anchor - centre), rotation.T @ axis)
        centre, rotation = data.xipos[i].copy(), data.ximat[i].reshape(3, 3).copy()
        body = lj.bodies.Body(f"link {i}", float(model.body_mass[i]), tuple(model.body_inertia[i].tolist()))
        joints[f"hinge {i}"] = lj.bodies.revolute(before, body.at(rotation.T @ (anchor - centre), rotation.T @ axis))
        turned, (place, turn, place_rate, turn_rate) = np.zeros(4), np.zeros((4, 3, 5))
        mujoco.mju_mat2Quat(turned, data.ximat[i])
        mujoco.mj_jac(model, data, place, turn, centre, i)
        mujoco.mj_jacDot(model, data, place_rate, turn_rate, centre, i)
        q[body.name] = lj.bodies.Pose(jnp.asarray(centre), jnp.asarray(turned))
        v[body.name] = q[body.name].moving(place @ data.qvel, turn @ data.qvel)
        expected[body.name] = place @ data.qacc + place_rate @ data.qvel, turn @ data.qacc + turn_rate @ data.qvel
        bodies.append(body)
        parent = body
    system = lj.bodies.multibody(bodies, joints, [lj.bodies.weight(bodies)])
    a, _ = lj.accelerations(system, 0.0, q, v, None)
    for body in bodies:
        # Of e'' only 2 vec(e'' e*) has a vector part: Ω' in space.
        spun = body.spin(q, a)
        scale = np.abs(np.concatenate(expected[body.name])).max()
        np.testing.assert_allclose(a[body.name].position, expected[body.name][0], atol=1e-9 * scale)
        np.testing.assert_allclose(spun, expected[body.name][1], atol=1e-9 * scale)
    assert np.abs(a["link 5"].position - expected["link 4"][0]).max() > 0.1


@pytest.mark.exhaustive
def test_a_parallelogram_of_four_hinges():
    """Four hinges of bodies in space have three equations too many, and still swing as a pendulum: sn, cn, dn.

    Two cranks of length r and mass c carry a bar of mass b that stays level: (2 (I + c r²/4) + b r²) θ'' =
    -(c + b) g r sin θ.
    """
    r, width, c, b = 0.5, 1.2, 0.7, 2.0
    inertia, axis = c * r**2 / 12, (0.0, 1.0, 0.0)
    left, right = (lj.bodies.Body(name, c, (inertia, inertia, 1e-3)) for name in ("left", "right"))
    bar = lj.bodies.Body("bar", b, (1e-3, b * width**2 / 12, b * width**2 / 12))
    up, down = (0.0, 0.0, r / 2), (0.0, 0.0, -r / 2)
    hinges = {
        "A": lj.bodies.revolute(lj.bodies.ground.at(axis=axis), left.at(up, axis)),
        "B": lj.bodies.revolute(left.at(down, axis), bar.at((-width / 2, 0.0, 0.0), axis)),
        "C": lj.bodies.revolute(bar.at((width / 2, 0.0, 0.0), axis), right.at(down, axis)),
        "D": lj.bodies.revolute(lj.bodies.ground.at((width, 0.0, 0.0), axis), right.at(up, axis)),
    }
    system = lj.bodies.multibody([left, right, bar], hinges, [lj.bodies.weight([left, right, bar])])
    angle = 0.8
    arm = r * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    q = {
        "left": lj.bodies.Pose.at(arm / 2, axis, -angle),
        "right": lj.bodies.Pose.at(arm / 2 + [width, 0.0, 0.0], axis, -angle),
        "bar": lj.bodies.Pose.at(arm + [width / 2, 0.0, 0.0]),
    }
    v = {name: pose.moving() for name, pose in q.items()}
    rate = np.sqrt((c + b) * G * r / (2 * (inertia + c * r**2 / 4) + b * r**2))
    k2 = np.sin(angle / 2) ** 2
    ts = np.linspace(0.0, 10 * 4 * ellipk(k2) / rate, 41)
    motion = lj.integrate(system, q, v, None, ts=ts, rtol=1e-12, estimate_error=False)
    angles = 2 * np.arcsin(np.sqrt(k2) * ellipj(rate * ts + ellipk(k2), k2)[0])
    place = np.stack([width / 2 + r * np.sin(angles), 0 * angles, -r * np.cos(angles)], axis=1)
    np.testing.assert_allclose(motion.q["bar"].position, place, atol=1e-9)
    assert (
        np.abs(np.asarray(motion.q["bar"].position)[:, 0] - width / 2 - r * np.sin(angle * np.cos(rate * ts))).max()
        > 0.01
    )
    assert residual(system, motion) < 1e-12
