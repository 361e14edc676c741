"""Random robots with everything on them, and random operating points of these robots."""

import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin

import fflin
from tests.support.robots import random_pose

# Frame outputs on one link.
SENSORS = (fflin.Accelerometer, fflin.Gyroscope, fflin.FramePose, fflin.FrameVelocity)


class Case(NamedTuple):
    """A robot, an operating point, and the arguments of `linearize` for this point."""

    robot: fflin.Robot
    point: tuple
    options: dict

    def linearize(self):
        return fflin.linearize(self.robot, *self.point, **self.options)


def random_case(seed):
    """Return a random `Case`; every seed gives another one."""
    rng = np.random.default_rng(seed)
    while True:
        try:
            robot = random_robot(rng)
            case = Case(robot, _point(robot, rng), _options(robot, rng))
            case.linearize()
        except fflin.SingularInertiaError:  # by chance, a motion moves almost no mass
            continue
        return case


def random_robot(rng):
    """A robot with wheels, modes, slosh, springs, mimic joints, sensors, and gravity or an orbit.

    Each of these is present with a chance of about one half. The masses of the links differ by up
    to 1e5, and the participation of a mode is between 1e-6 and about 1.
    """
    links = _links(rng)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "random.urdf"
        path.write_text(_urdf(links, rng))
        robot = fflin.load(path)
    robot = robot.replace(appendages=_appendages(links, rng))
    names = [joint.name for joint in robot.joints if joint not in robot.modes]
    if rng.random() < 0.5:
        # Springs with frequencies of about 0.1 to 10 rad/s.
        inertia = np.abs(fflin.linearize(robot).M.diagonal())[6:]
        scales = dict(zip(robot.joint_names, inertia, strict=True))
        sprung = [name for name in names if rng.random() < 0.7]
        robot = robot.replace(
            stiffness={
                name: scales[name] * 10.0 ** rng.uniform(-2, 2) for name in sprung
            },
            damping={
                name: scales[name] * 10.0 ** rng.uniform(-3, 0) for name in sprung
            },
        )
    robot = _with_inputs(robot, links, rng)
    kind = rng.choice(["free", "gravity", "orbit"])
    if kind == "gravity":
        robot = robot.replace(gravity=rng.normal(size=3) * 10.0 ** rng.uniform(-3, 1))
    if kind == "orbit":
        robot = robot.replace(orbit=float(10.0 ** rng.uniform(5.3, 7.0)))
    return robot.replace(outputs=_outputs(robot, links, rng))


class Link(NamedTuple):
    """A link of a random robot; its inertia (3, 3) is about its centre of mass."""

    name: str
    mass: float
    center: np.ndarray
    inertia: np.ndarray


def _links(rng):
    """Links with masses that differ by up to 1e5; the first one is the base."""
    masses = 10.0 ** rng.uniform(0.0, 3.5) * 10.0 ** -rng.uniform(
        0.0, 5.0, rng.integers(1, 8)
    )
    masses[0] = 1.2 * masses.max()
    links = []
    for k, mass in enumerate(masses):
        size = 0.5 * 10.0 ** rng.uniform(-1.0, 0.3)
        # Half-axes of a solid ellipsoid, turned in a random way.
        axes = size * rng.uniform(0.2, 1.0, 3)
        moments = mass / 5.0 * (axes @ axes - axes**2)
        turn = random_pose(rng, 180.0 * rng.random()).rotation
        inertia = turn @ np.diag(moments) @ turn.T
        links.append(Link(f"link_{k}", mass, size * rng.normal(size=3), inertia))
    return links


def _urdf(links, rng):
    text = ['<robot name="random">']
    for link in links:
        (xx, xy, xz), (_, yy, yz), (*_, zz) = link.inertia.tolist()
        x, y, z = link.center.tolist()
        text.append(
            f'<link name="{link.name}"><inertial><origin xyz="{x!r} {y!r} {z!r}"/>'
            f'<mass value="{float(link.mass)!r}"/><inertia ixx="{xx!r}" ixy="{xy!r}" ixz="{xz!r}" '
            f'iyy="{yy!r}" iyz="{yz!r}" izz="{zz!r}"/></inertial></link>'
        )
    leaders = []
    # In one robot of five, the joints are about ten metres apart.
    reach = 10.0 if rng.random() < 0.2 else 1.0
    for k, link in enumerate(links[1:], 1):
        kind = rng.choice(["revolute", "continuous", "prismatic"], p=[0.5, 0.2, 0.3])
        parent = links[rng.integers(max(0, k - 2), k)].name
        place = rng.normal(size=3) * reach * 10.0 ** rng.uniform(-1.0, 0.0)
        axis = rng.normal(size=3)
        if rng.random() < 0.3:
            axis = np.eye(3)[rng.integers(3)]
        mimic = ""
        if kind != "continuous" and leaders and rng.random() < 0.15:
            ratio, offset = rng.normal(size=2).tolist()
            mimic = (
                f'<mimic joint="{rng.choice(leaders)}" '
                f'multiplier="{ratio!r}" offset="{offset!r}"/>'
            )
        elif kind != "continuous":
            leaders.append(f"joint_{k}")
        text.append(
            f'<joint name="joint_{k}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="{link.name}"/><origin xyz="{_numbers(place)}" '
            f'rpy="{_numbers(rng.normal(size=3))}"/><axis xyz="{_numbers(axis)}"/>'
            f'<limit lower="-9" upper="9" effort="1" velocity="1"/>{mimic}</joint>'
        )
    return "\n".join([*text, "</robot>"])


def _numbers(vector):
    return " ".join(map(repr, map(float, vector)))


def _appendages(links, rng):
    """Arrays and tanks on some links; the remaining rigid inertia stays positive definite."""
    result = []
    for link in links:
        if rng.random() < 0.4:
            # Spatial inertia about the link's origin. L is at most 0.6 of its Cholesky factor, so
            # the rest of the inertia is positive definite.
            body = pin.Inertia(link.mass, link.center, link.inertia)
            count = int(rng.integers(1, 4))
            columns = np.linalg.qr(rng.normal(size=(6, count)))[0]
            columns *= 0.6 * 10.0 ** rng.uniform(-6.0, 0.0, count)
            L = np.linalg.cholesky(body.matrix()) @ columns
            result.append(
                fflin.FlexibleAppendage(
                    link.name,
                    10.0 ** rng.uniform(-2.0, 1.5, count),
                    L[:3],
                    L[3:],
                    damping=rng.uniform(0.0, 0.1, count),
                    name=f"array_{link.name}",
                )
            )
        elif rng.random() < 0.3:
            shift = 0.3 * np.sqrt(np.linalg.eigvalsh(link.inertia)[0] / link.mass)
            pendulum = rng.random() < 0.5
            result.append(
                fflin.Slosh(
                    link.name,
                    link.mass * 10.0 ** rng.uniform(-4.0, -0.7),
                    link.center + shift * rng.uniform(-1.0, 1.0, 3),
                    frequency=None if pendulum else 10.0 ** rng.uniform(-2.0, 0.5),
                    length=0.5 * shift if pendulum else None,
                    axis=rng.normal(size=3),
                    name=f"tank_{link.name}",
                )
            )
    return result


def _with_inputs(robot, links, rng):
    """Return the robot with its default inputs, or with thrusters, wheels and joint torques."""
    if rng.random() < 0.3:
        return robot
    inputs = []
    if rng.random() < 0.5:
        inputs += [fflin.BaseTorque(), fflin.BaseForce()]
    for k in range(rng.integers(0, 4)):
        link = links[rng.integers(len(links))].name
        inputs.append(
            fflin.Thruster(
                link, rng.normal(size=3), rng.normal(size=3), f"thruster_{k}"
            )
        )
    for k in range(rng.integers(0, 4)):
        link = links[rng.integers(len(links))]
        moment = float(np.linalg.eigvalsh(link.inertia)[0])
        axis = rng.normal(size=3)
        if rng.random() < 0.5:
            momentum = moment * rng.normal() * 10.0 ** rng.uniform(0.0, 2.0)
            wheel = fflin.ReactionWheel(
                axis, link.name, momentum=momentum, name=f"wheel_{k}"
            )
        else:
            inertia = moment * 10.0 ** rng.uniform(-5.0, -1.5)
            wheel = fflin.ReactionWheel(axis, link.name, inertia, name=f"wheel_{k}")
        inputs.append(wheel)
    modes = {mode.name for mode in robot.modes}
    joints = [name for name in robot.joint_names if name not in modes]
    inputs += [fflin.JointTorque(name) for name in joints if rng.random() < 0.8]
    try:
        return robot.replace(inputs=inputs or [fflin.BaseTorque()])
    except (
        fflin.InputError
    ):  # the link with an appendage has less inertia than the wheel
        return robot


def _outputs(robot, links, rng):
    if rng.random() < 0.3:
        return [fflin.FullState()]
    kinds = [
        kind for kind in SENSORS if not (robot.orbit and kind is fflin.Accelerometer)
    ]
    chosen = rng.permutation(len(links))[:2]
    outputs = [
        kind(links[k].name) for k in chosen for kind in kinds if rng.random() < 0.7
    ]
    if len(links) > 2 and rng.random() < 0.5:
        outputs.append(fflin.RelativePose(links[-1].name, links[-2].name))
    if rng.random() < 0.5:
        outputs.append(fflin.CenterOfMass())
    if not robot.orbit and rng.random() < 0.5:
        outputs.append(fflin.Momentum())
    if rng.random() < 0.5:
        outputs += [fflin.BasePose(), fflin.JointPositions(), fflin.JointVelocities()]
    return outputs or [fflin.CenterOfMass()]


def _point(robot, rng):
    """A random q, v and u of a robot; each part is at rest in some of the points."""
    # Modes move their masses by up to about 0.3 rad or 0.3 m.
    spans = np.array(
        [0.3 / joint.scale if joint.mode else 2.5 for joint in robot.joints]
    )
    values = spans * rng.uniform(-1.0, 1.0, robot.n)
    joints = dict(zip(robot.joint_names, values, strict=True))
    if rng.random() < 0.2:
        joints = {}
    turned = rng.choice([0.0, rng.uniform(0.0, 160.0)], p=[0.3, 0.7])
    q = fflin.configuration(robot, joints, random_pose(rng, turned))
    model = fflin.linearize(robot.replace(outputs=[fflin.FullState()]), q)
    u = np.zeros(len(model.u0))
    nu = np.zeros(6 + robot.n)
    if rng.random() < 0.7:
        nu = rng.normal(size=6 + robot.n) * 10.0 ** rng.uniform(-6.0, 0.3)
        if rng.random() < 0.3:
            nu[:3] = 0.0
        if rng.random() < 0.3:
            nu[6:] = 0.0
        if rng.random() < 0.1 and not robot.orbit:
            nu[3:6] *= 1e3
        for k, name in enumerate(robot.joint_names, 6):
            nu[k] /= robot.joint(name).scale
            if name in robot.wheels:
                nu[k] *= 100.0
    if rng.random() < 0.7:
        # Inputs that accelerate the robot by about 1 or less.
        lower = model.B[-len(nu) :]
        inertia = np.sqrt(np.einsum("ik,ij,jk->k", lower, model.M, lower))
        u = rng.normal(size=len(u)) * 10.0 ** rng.uniform(-4.0, 0.0)
        u /= np.where(inertia > 0.0, inertia * np.sqrt(model.M.diagonal().min()), 1.0)
    return q, fflin.StateMap(robot).spread(nu), u


def _options(robot, rng):
    """Frame, reference and `moving` for `linearize`."""
    if not robot.orbit and rng.random() < 0.2:
        return {"moving": True}
    frames = ("lvlh", "hill") if robot.orbit else ("hybrid", "local", "world")
    options = {"frame": str(rng.choice(frames))}
    if robot.orbit or rng.random() < 0.7:
        # Without this reference, the base is at the reference.
        options["reference"] = pin.SE3.Identity()
    return options
