"""Models in the coordinates of Drake, MuJoCo and Pinocchio are those that they make themselves."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from benchmarks.robots import BASE, plain_urdf
from tests.support.robots import FRAMES, random_point

# Bodies that can exist, which Drake and MuJoCo insist on.
ROBOTS = ("servicer_7dof", "canadarm2", "dual_arm", "cubesat")


@pytest.fixture(params=ROBOTS)
def motion(request, tmp_path):
    """A robot in motion, turned and pushed, and the file that all read."""
    path = tmp_path / "robot.urdf"
    path.write_text(plain_urdf(fflin.load(request.param)))
    robot = fflin.load(path)
    return (
        robot,
        path.read_text(),
        *random_point(robot, np.random.default_rng(11), degrees=80.0),
    )


def relative(a, b):
    return np.abs(a - b).max() / max(1.0, np.abs(b).max())


def last_body(robot, q, v):
    """Placement and velocity, in world axes, of the last joint's body by Pinocchio."""
    model, data = robot.model, robot.create_data()
    pin.forwardKinematics(model, data, q, v)
    index, axes = model.njoints - 1, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    bodies = [f for f in model.frames if f.type == pin.FrameType.BODY]
    name = next(f.name for f in bodies if f.parentJoint == index)
    return name, data.oMi[index], pin.getVelocity(model, data, index, axes)


def drake_plant(urdf):
    parsing = pytest.importorskip("pydrake.multibody.parsing")
    from pydrake.multibody.plant import MultibodyPlant

    plant = MultibodyPlant(time_step=0.0)
    parsing.Parser(plant).AddModelsFromString(urdf, "urdf")
    plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    plant.Finalize()
    return plant


def test_drake(motion):
    robot, urdf, q, v, u = motion
    plant = drake_plant(urdf)
    from pydrake.systems.framework import OutputPortSelection
    from pydrake.systems.primitives import FirstOrderTaylorApproximation

    m = fflin.linearize(robot, q, v, u).to("drake")
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, np.concatenate((m.q, m.v)))
    port = plant.get_applied_generalized_force_input_port()
    port.FixValue(context, m.u0)
    name, place, velocity = last_body(robot, q, v)
    body = plant.GetBodyByName(name)
    seen = plant.EvalBodyPoseInWorld(context, body).GetAsMatrix4()
    assert np.abs(seen - place.homogeneous).max() < 1e-12
    seen = plant.EvalBodySpatialVelocityInWorld(context, body)
    assert np.abs(seen.translational() - velocity.linear).max() < 1e-12
    assert np.abs(seen.rotational() - velocity.angular).max() < 1e-12
    rates = plant.EvalTimeDerivatives(context).get_vector().CopyToVector()
    theirs = FirstOrderTaylorApproximation(
        plant, context, port.get_index(), OutputPortSelection.kNoOutput
    )
    # All 13 + 2n columns, that of the quaternion's length too.
    for frame in FRAMES:
        lin = fflin.linearize(
            robot,
            q,
            v,
            fflin.from_tool(robot, "drake", m.q, m.v, m.u0, frame=frame).u0,
            frame=frame,
        )
        mine = lin.to("drake")
        assert relative(mine.f0, rates) < 1e-11
        assert (
            relative(mine.A, theirs.A()) < 1e-11
            and relative(mine.B, theirs.B()) < 1e-11
        )
        back = fflin.from_tool(
            robot, "drake", m.q, m.v, m.u0, A=theirs.A(), B=theirs.B(), frame=frame
        )
        assert relative(back.A, lin.A) < 1e-11 and relative(back.B, lin.B) < 1e-11


def mujoco_model(urdf, h):
    mujoco = pytest.importorskip("mujoco")
    spec = mujoco.MjSpec.from_string(urdf)
    spec.compiler.fusestatic = False
    spec.body(BASE).add_freejoint(name="free")
    model = spec.compile()
    off = mujoco.mjtDisableBit
    model.opt.disableflags |= off.mjDSBL_CONSTRAINT | off.mjDSBL_CONTACT
    model.opt.gravity[:] = 0.0
    model.opt.timestep = h
    model.dof_damping[:] = model.dof_armature[:] = 0.0
    return mujoco, model, mujoco.MjData(model)


def test_mujoco(motion):
    robot, urdf, q, v, u = motion
    h = 1e-3
    mujoco, model, data = mujoco_model(urdf, h)
    lin = fflin.linearize(robot, q, v, u)
    m, nv = lin.to("mujoco", dt=h), model.nv
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = m.q, m.v, m.u0
    mujoco.mj_forward(model, data)
    name, place, velocity = last_body(robot, q, v)
    body = model.body(name).id
    assert np.abs(data.xpos[body] - place.translation).max() < 1e-12
    assert np.abs(data.xmat[body].reshape(3, 3) - place.rotation).max() < 1e-12
    seen = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, seen, 0)
    assert (
        np.abs(seen - np.concatenate((velocity.angular, velocity.linear))).max() < 1e-12
    )
    # Theirs are differences, good to some 1e-6 of the accelerations; there is no B of qfrc_applied.
    A = np.zeros((2 * nv, 2 * nv))
    mujoco.mjd_transitionFD(model, data, 1e-6, True, A, None, None, None)
    assert np.abs(m.A - A).max() < 1e-5 * h * max(1.0, np.abs(lin.A).max())
    before, apart = np.array(m.q), np.zeros(nv)
    mujoco.mj_step(model, data)
    mujoco.mj_differentiatePos(model, apart, 1.0, before, data.qpos)
    assert relative(np.concatenate((apart, data.qvel - m.v)), m.f0) < 1e-11
    # B by steps of the force, in which a step is linear but for the turn that it makes.
    B, push = np.zeros((2 * nv, nv)), np.abs(m.u0).max()
    for column, e in enumerate(np.eye(nv)):
        ends = []
        for sign in (1.0, -1.0):
            data.qpos[:], data.qvel[:] = m.q, m.v
            data.qfrc_applied[:] = m.u0 + sign * 1e-2 * push * e
            mujoco.mj_step(model, data)
            ends.append((data.qpos.copy(), data.qvel.copy()))
        mujoco.mj_differentiatePos(model, apart, 1.0, ends[1][0], ends[0][0])
        B[:, column] = np.concatenate((apart, ends[0][1] - ends[1][1])) / (2e-2 * push)
    assert np.abs(m.B - B).max() < 1e-6 * np.abs(B).max()
    back = fflin.from_tool(robot, "mujoco", m.q, m.v, m.u0, A=A, dt=h)
    assert relative(back.A, lin.A) < 1e-5


def test_pinocchio(motion):
    robot, _, q, v, u = motion
    model, data, nv = robot.model, robot.create_data(), robot.nv
    m = fflin.linearize(robot, q, v, u, frame="world").to("pinocchio")
    pin.computeABADerivatives(model, data, m.q, m.v, m.u0)
    data.Minv[:] = np.triu(data.Minv) + np.triu(data.Minv, 1).T
    assert relative(m.A[nv:, :nv], data.ddq_dq) < 1e-9
    assert relative(m.A[nv:, nv:], data.ddq_dv) < 1e-9
    assert relative(m.B[nv:], data.Minv) < 1e-9 and not m.B[:nv].any()
    assert relative(m.f0, np.concatenate((m.v, data.ddq))) < 1e-9
    # Above: of the logarithm of the displacement, over itself and over v.
    assert np.abs(m.A[:nv, nv:] - np.eye(nv)).max() < 1e-15

    def rate(t, e):
        start = pin.integrate(model, m.q, t * e)
        ahead, behind = (
            pin.difference(model, m.q, pin.integrate(model, start, s * m.v))
            for s in (1e-3, -1e-3)
        )
        return (ahead - behind) / 2e-3

    slopes = [(rate(1e-3, e) - rate(-1e-3, e)) / 2e-3 for e in np.eye(nv)]
    assert np.abs(m.A[:nv, :nv] - np.transpose(slopes)).max() < 1e-4


def test_joints_are_in_the_order_of_the_tool(tmp_path):
    """Pinocchio sorts siblings by name; Drake and MuJoCo take them as the file has them."""
    body = (
        '<mass value="1"/><inertia ixx=".2" ixy="0" ixz="0" iyy=".2" iyz="0" izz=".2"/>'
    )
    names = {"z": BASE, "zz": "z", "a": BASE, "aa": "a"}
    links = "".join(
        f'<link name="{n}"><inertial>{body}</inertial></link>' for n in (BASE, *names)
    )
    joints = "".join(
        f'<joint name="to_{n}" type="{"prismatic" if n == "zz" else "revolute"}">'
        f'<parent link="{parent}"/><child link="{n}"/><origin xyz=".3 .1 .2" rpy=".1 .2 .3"/>'
        '<axis xyz="0 .6 .8"/><limit lower="-3" upper="3" effort="9" velocity="9"/></joint>'
        for n, parent in names.items()
    )
    path = tmp_path / "forks.urdf"
    path.write_text(f'<robot name="forks">{links}{joints}</robot>')
    robot = fflin.load(path)
    assert robot.joint_names == ("to_a", "to_aa", "to_z", "to_zz")
    q, v, u = random_point(robot, np.random.default_rng(2), degrees=40.0)
    lin, order = fflin.linearize(robot, q, v, u), tuple(f"to_{n}" for n in names)
    plant = drake_plant(path.read_text())
    m = lin.to("drake")
    kinds = {"rad": "q", "m": "x"}
    states = zip(m.state_names[7:11], m.state_units[7:11], strict=True)
    assert plant.GetPositionNames()[7:] == [
        f"forks_{name.removeprefix('q_m.')}_{kinds[unit]}" for name, unit in states
    ]
    context = plant.CreateDefaultContext()
    plant.SetPositionsAndVelocities(context, np.concatenate((m.q, m.v)))
    plant.get_applied_generalized_force_input_port().FixValue(context, m.u0)
    rates = plant.EvalTimeDerivatives(context).get_vector().CopyToVector()
    assert relative(m.f0, rates) < 1e-11
    _, model, _ = mujoco_model(path.read_text(), 1e-3)
    assert [model.joint(i).name for i in range(1, model.njnt)] == list(order)
    back = fflin.from_tool(robot, "drake", m.q, m.v, m.u0, A=m.A, B=m.B)
    assert relative(back.A, lin.A) < 1e-13 and relative(back.q, lin.q) < 1e-13
