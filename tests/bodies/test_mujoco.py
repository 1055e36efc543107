"""Scenes from MuJoCo: its own constraint rows, distances and energies, and our bodies, agree."""

import sys
import warnings

import mujoco
import numpy as np
import pytest
from refusals import argument

import jimpact as ji

FLOOR = '<geom name="floor" type="plane" size="2 2 .1" friction=".5"/>'


FREE = "<freejoint/>"


def load(bodies, options="", rest=""):
    """Model and data of these bodies over a floor."""
    text = f"<mujoco>{options}<worldbody>{FLOOR}{bodies}</worldbody>{rest}</mujoco>"
    model = mujoco.MjModel.from_xml_string(text)
    return model, mujoco.MjData(model)


def body(position, geom, joints=FREE, name="", euler="0 0 0"):
    """A body of one geom."""
    return f'<body name="{name}" pos="{position}" euler="{euler}">{joints}<geom {geom}/></body>'


BOX = 'name="box" type="box" size=".1 .15 .2" mass="1.5" friction=".3"'


PILE = (
    body("0 0 .1999", BOX, euler="0 0 30", name="box")
    + body("0 0 .4995", 'name="ball" type="sphere" size=".1" mass=".7"')
    + body(
        ".145 .05 .3",
        'name="rod" type="capsule" size=".05 .2" mass="2"',
        euler="5 0 30",
    )
    + body(
        "-.7 0 .15",
        'name="arm" type="box" size=".1 .1 .1" mass="1"',
        joints='<joint type="hinge" axis="0 1 0" pos="-.3 0 0"/>',
    )
    + body(
        "-.7 0 .449",
        'name="wheel" type="cylinder" size=".2 .05" mass="1"',
        euler="90 0 0",
    )
    + body(
        ".8 0 .1495", 'name="tip" type="mesh" mesh="wedge" mass="1"', euler="10 20 0"
    )
)


MESH = '<asset><mesh name="wedge" vertex="0 0 -.15  .2 0 .1  -.1 .2 .1  -.1 -.2 .1"/></asset>'


@pytest.fixture(scope="module")
def pile():
    model, data = load(PILE, "<option cone='elliptic'/>", MESH)
    data.qvel[:] = np.random.default_rng(0).normal(size=model.nv)
    data.qpos[-7 + 2] -= mujoco_distance(model, data, "floor", "tip") + 1e-4
    return model, data, ji.from_mujoco(model, data)


def mujoco_distance(model, data, first, second):
    mujoco.mj_forward(model, data)
    ids = [
        mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, n) for n in (first, second)
    ]
    return mujoco.mj_geomDistance(model, data, *ids, 1.0, None)


def test_rows_are_those_of_mujoco(pile):
    model, data, world = pile
    mujoco.mj_forward(model, data)
    rows = data.efc_J.reshape(-1, model.nv)
    starts = [c.efc_address for c in data.contact]
    assert len(starts) == world.scene.contacts > 8
    ours = np.asarray(world.scene.normals).T
    # the iteration that finds contacts of a cylinder ends elsewhere with a margin, 2e-10 apart
    np.testing.assert_allclose(ours, rows[starts], atol=1e-9)
    tangents = np.asarray(world.scene.tangents).T.reshape(len(starts), 2, -1)
    for k in (0, 1):
        np.testing.assert_allclose(
            tangents[:, k], rows[np.add(starts, 1 + k)], atol=1e-9
        )
    np.testing.assert_array_equal(world.friction, [c.friction[0] for c in data.contact])
    inverse = np.linalg.inv(np.asarray(world.scene.mass))  # the diagonal of N^T M^-1 N
    w = np.einsum("ij,jk,ik->i", ours, inverse, ours)
    np.testing.assert_allclose(np.diag(ji.delassus_matrix(world.scene)), w, rtol=1e-12)


def test_the_scene_prints_a_row_for_each_contact(pile):
    _, _, world = pile
    head, columns, *rows = str(world).splitlines()
    contacts = world.scene.contacts
    assert head == f"{world.scene.size} coordinates (as data.qvel), {contacts} contacts"
    for word in ("geoms", "gap [m]", "gap velocity [m/s]", "friction"):
        assert word in columns
    assert [row.split()[0] for row in rows] == [str(j + 1) for j in range(contacts)]
    assert world.names[0] in rows[0]


def test_gap_velocities_are_rates_of_distances(pile):
    model, data, world = pile
    gamma = np.asarray(ji.gap_velocity(world.scene, world.velocity))
    step, start = 1e-6, data.qpos.copy()
    for pair in (("floor", "tip"), ("box", "ball")):  # one contact each
        ends = []
        for sign in (1, -1):
            data.qpos[:] = start
            mujoco.mj_integratePos(model, data.qpos, data.qvel, sign * step)
            ends.append(mujoco_distance(model, data, *pair))
        data.qpos[:] = start
        where = [
            name in (", ".join(pair), ", ".join(pair[::-1])) for name in world.names
        ]
        assert sum(where) == 1
        assert gamma[where] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-6)


def test_energy_is_that_of_mujoco(pile):
    model, data, world = pile
    mujoco.mj_energyVel(model, data)
    assert float(ji.kinetic_energy(world.scene, world.velocity)) == pytest.approx(
        data.energy[1]
    )


def test_a_box_is_our_box():
    model, data = load(body("0 0 .2", BOX))
    data.qpos[3:7] = turned = np.array([0.9, 0.1, -0.2, 0.3]) / np.sqrt(0.95)
    data.qpos[2] = 1.0
    data.qpos[2] -= mujoco_distance(model, data, "floor", "box")
    data.qvel[:] = [0.1, 0.2, -1.0, 0.3, 0.4, 0.5]
    world = ji.from_mujoco(model, data)
    ours = ji.Box((0.2, 0.3, 0.4), mass=1.5)
    scene = ours.scene(ours.at(data.qpos[:3], turned), closed_below=1e-9)
    touching = int(np.argmin(np.asarray(scene.gaps)))
    np.testing.assert_allclose(world.scene.mass, scene.mass, rtol=1e-12)
    np.testing.assert_allclose(
        world.scene.normals[:, 0], scene.normals[:, touching], atol=1e-9
    )


def slider(number, x):
    joint = '<joint type="slide" axis="1 0 0"/>'
    return body(f"{x} 0 1", f'name="g{number}" size=".05" mass="1"', joint)


def test_balls_that_touch_but_for_rounding_touch():
    model, data = load("".join(slider(i, 0.1 * i) for i in range(5)))
    data.qvel[0] = 1.0
    world = ji.from_mujoco(model, data)
    assert world.names == ("g0, g1", "g1, g2", "g2, g3", "g3, g4")
    assert world.scene.gaps is None
    assert world.scene.tangents is None
    assert world.friction is None
    cradle = ji.chain([1.0] * 5)
    np.testing.assert_allclose(world.scene.normals, cradle.normals, atol=1e-15)
    np.testing.assert_allclose(world.scene.mass, cradle.mass, rtol=1e-15)


def test_a_margin_finds_gaps():
    model, data = load("".join(slider(i, 0.1001 * i) for i in range(3)))
    with pytest.raises(ValueError, match=argument("data")):
        ji.from_mujoco(model, data)
    world = ji.from_mujoco(model, data, margin=1e-3)
    np.testing.assert_allclose(world.scene.gaps, 1e-4, rtol=1e-9)
    assert model.geom_margin.max() == 0.0  # the model is as it was


def test_a_planar_model_has_planar_tangents():
    planar = "".join(
        f'<joint type="{kind}" axis="{axis}"/>'
        for kind, axis in (("slide", "1 0 0"), ("slide", "0 0 1"), ("hinge", "0 1 0"))
    )
    model, data = load(
        body("0 0 .2", 'name="disc" type="sphere" size=".2" mass="1"', planar)
    )
    world = ji.from_mujoco(model, data)
    assert world.scene.tangents.shape == (3, 1)
    # the lowest point slides at x' - r theta', whichever way the tangent points
    tangent = np.asarray(world.scene.tangents)[:, 0]
    np.testing.assert_allclose(tangent / tangent[0], [1.0, 0.0, -0.2], atol=1e-12)
    assert abs(tangent[0]) == pytest.approx(1.0)


LINKED = body(
    "0 0 .1", 'name="left" type="sphere" size=".1" mass="1"', name="a"
) + body(".5 0 .1", 'name="right" type="sphere" size=".1" mass="3"', name="b")


JOINED = '<equality><weld body1="a" body2="b"/><connect body1="a" body2="b" anchor="0 0 0"/></equality>'


@pytest.mark.parametrize("storage", ["sparse", "dense"])
def test_equality_constraints_are_bilateral_constraints(storage):
    model, data = load(LINKED, f'<option jacobian="{storage}"/>', JOINED)
    data.qvel[[2, 8]] = -1.0, -1.002  # a weld that drifts
    world = ji.from_mujoco(model, data)
    assert world.scene.constraints.shape == (12, 6)  # the connection repeats the weld
    h, v = np.asarray(world.scene.constraints), np.asarray(world.velocity)
    np.testing.assert_allclose(h.T @ v, 0, atol=1e-12)
    # momentum about every axis of the welded pair is kept: M (v - qvel) is a reaction, in span(h)
    change = np.diag(np.asarray(world.scene.mass)) @ (v - data.qvel)
    np.testing.assert_allclose(
        change - h @ np.linalg.lstsq(h, change)[0], 0, atol=1e-12
    )
    # one rigid body: both ends at -1, so the weld moves straight down
    assert v[2] == pytest.approx(-1.0, abs=2e-3)


@pytest.mark.slow
def test_a_welded_foot_and_a_locked_joint_at_its_stop_take_no_part():
    hinge = '<joint name="hinge" axis="0 1 0" range="-40 0" limited="true"/>'
    arm = body(
        "0 2 .5", 'type="sphere" size=".05" pos=".3 0 0" mass="2"', hinge, name="arm"
    )
    held = '<equality><joint joint1="hinge"/><weld body1="a"/></equality>'
    model, data = load(LINKED + arm, rest=held)
    data.qvel[8] = -1.4
    world = ji.from_mujoco(model, data)
    assert world.scene.contacts == 3
    out = ji.impact(ji.Newton(0.3), world.scene, world.velocity)
    assert ji.STATUS[int(out.status)].name == "ok"
    np.testing.assert_allclose(
        sorted(out.impulse), [0.0, 0.0, 3.0 * 1.3 * 1.4], atol=1e-9
    )


def test_velocities_against_constraints_are_named():
    model, data = load(LINKED, rest=JOINED)
    data.qvel[[2, 8]] = -1.0, 1.0
    with pytest.warns(UserWarning, match="breaks equality constraints"):
        ji.from_mujoco(model, data)


def test_what_is_left_out_is_named():
    limited = (
        '<joint name="knee" type="hinge" axis="0 1 0" limited="true" range="10 90"/>'
    )
    rolling = (
        'name="{}" type="sphere" size=".1" mass="1" condim="6" friction=".3 .1 .2"'
    )
    bodies = body("0 0 .04", rolling.format("sunk")) + body(
        "1 0 1", 'size=".1"', limited
    )
    model, data = load(
        bodies,
        rest='<contact><pair geom1="floor" geom2="sunk" condim="4" friction=".3 .6 .1 0 0"/></contact>',
    )
    with warnings.catch_warnings(record=True) as record:
        warnings.simplefilter("always")
        world = ji.from_mujoco(model, data)
    said = " ".join(str(w.message) for w in record)
    assert "'floor, sunk' by 0.06 m" in said
    assert "'floor, sunk': 0.3 and 0.6" in said
    assert "Torsional or rolling" in said
    assert "'limit of joint knee' by 0.175 rad" in said
    assert len(record) == 4  # one for each kind
    np.testing.assert_array_equal(world.friction, [0.3, 0.0])


def test_limits_of_joints_are_contacts():
    """A pendulum of length .5 m that swings into its limit with e = .5, and one near its limit."""
    hinge = '<joint name="{}" type="hinge" axis="0 1 0" pos="0 0 .5" limited="true" range="0 90"/>'
    ball = 'type="sphere" size=".1" mass="2"'
    bodies = body("0 0 2", ball, hinge.format("knee")) + body(
        "3 0 2", ball, hinge.format("hip")
    )
    model, data = load(bodies)
    data.qpos[1] = 0.01
    data.qvel[:] = -2.0, -1.0
    world = ji.from_mujoco(model, data, margin=0.02)
    assert world.names == ("limit of joint knee", "limit of joint hip")
    np.testing.assert_allclose(world.scene.gaps, [0.0, 0.01], atol=1e-12)
    assert world.friction is None
    out = ji.impact(ji.Moreau(0.5), world.scene, world.velocity)
    np.testing.assert_allclose(out.velocity, [1.0, -1.0], atol=1e-12)


def test_contacts_without_friction_have_none():
    frictionless = 'name="{}" type="sphere" size=".1" mass="1" condim="1" friction=".4"'
    model, data = load(body("0 0 .1", frictionless.format("")))
    model.geom_condim[:] = 1
    world = ji.from_mujoco(model, data)
    np.testing.assert_array_equal(world.friction, [0.0])
    assert world.names == ("floor, body 1 (geom 1)",)


def test_errors_name_the_argument(monkeypatch):
    model, data = load(body("0 0 .2", BOX))
    other = mujoco.MjData(load(LINKED)[0])
    with pytest.raises(ValueError, match=argument("data")):
        ji.from_mujoco(model, other)
    with pytest.raises(TypeError, match=argument("model")):
        ji.from_mujoco("robot.xml", data)
    with pytest.raises(ValueError, match="margin"):
        ji.from_mujoco(model, data, margin=-1.0)
    data.qpos[0] = np.nan
    with pytest.raises(ValueError, match=argument("data.qpos", "nan")):
        ji.from_mujoco(model, data)
    data.qpos[0] = 0.0
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"pip install 'jimpact\[mujoco\]'"):
        ji.from_mujoco(model, data)


def test_an_outcome_goes_back():
    """A ball on a tilted floor: the normal velocity is reversed, the rest is kept."""
    model, data = load(body("0 0 .1", 'name="ball" type="sphere" size=".1" mass="2"'))
    data.qvel[:] = [1.0, 2.0, -3.0, 0.1, 0.2, 0.3]
    world = ji.from_mujoco(model, data)
    data.qvel[:] = ji.impact(ji.Newton(0.5), world.scene, world.velocity).velocity
    np.testing.assert_allclose(data.qvel, [1.0, 2.0, 1.5, 0.1, 0.2, 0.3], rtol=1e-12)


FLAT, RISING = (0.95, 0.95, 0.001, 0.5, 2.0), (0.3, 0.9, 0.01, 0.3, 3.0)


def bounce(solref, step, solimp, speed, phase):
    """e of a ball on a plane in MuJoCo; the contact begins at this part of a step."""
    default = f'<default><geom solref="{solref[0]} {solref[1]}" solimp="{" ".join(map(str, solimp))}"/></default>'
    options = f'<option timestep="{step}" gravity="0 0 0"/>{default}'
    model, data = load(body("0 0 1", 'size=".1" mass=".3"'), options)
    data.qpos[2] = 0.1 - speed * step * phase
    data.qvel[2] = -speed
    while data.qpos[2] < 0.1:
        mujoco.mj_step(model, data)
    return data.qvel[2] / speed


@pytest.mark.parametrize(
    "solref", [(0.02, 0.554), (0.02, 0.1), (0.002, 1.0), (-1e5, -30.0)]
)
@pytest.mark.parametrize("solimp", [FLAT, RISING])
def test_restitution_is_that_of_mujoco(solref, solimp):
    step, speed = 0.004, 0.7
    e = [bounce(solref, step, solimp, speed, (i + 0.5) / 64) for i in range(64)]
    ours = ji.mujoco_restitution(solref, step, solimp, speed)
    assert ours == pytest.approx((np.mean(e), min(e), max(e)), rel=1e-12)


def test_small_steps_give_the_linear_oscillator():
    """Without pull it ends at e = exp(-2 z / r atan(r / z)) with r^2 = 1 - z^2."""
    for zeta in (0.1, 0.554, 0.9):
        root = np.sqrt(1 - zeta**2)
        e = np.exp(-2 * zeta / root * np.arctan(root / zeta))
        assert ji.mujoco_restitution((0.02, zeta), 1e-5, FLAT).mean == pytest.approx(
            e, abs=1e-3
        )


@pytest.mark.parametrize("e", [0.02, 0.27, 0.9, 1.0])
def test_a_solref_gives_its_restitution(e):
    solref = ji.mujoco_solref(e, 0.002)
    measured = [
        bounce(solref, 0.002, (0.9, 0.95, 0.001, 0.5, 2.0), 1.0, x / 16)
        for x in range(1, 17)
    ]
    assert np.mean(measured) == pytest.approx(e, abs=3e-3)
    assert ji.mujoco_restitution(solref, 0.002).mean == pytest.approx(e, abs=1e-6)
