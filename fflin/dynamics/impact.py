"""Impacts: sudden changes of a robot by a grasp or a jammed joint, and the new velocities."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.tables import folded
from fflin.base.validation import Array, FrozenArrays, dimension, instance, vector
from fflin.base.validation import placement as checked_placement
from fflin.dynamics.closure import Closure
from fflin.dynamics.constraints import Constraints
from fflin.dynamics.coordinates import refuse_elliptic
from fflin.dynamics.state import StateMap
from fflin.robot.constraints import Constraint, checked_constraints
from fflin.robot.joints import ROOT, by_joint, find_frame
from fflin.robot.loading import body_alone
from fflin.robot.outputs import ConstraintForce
from fflin.robot.robot import Robot
from fflin.robot.welding import joined, welded


@dataclass(frozen=True, eq=False, repr=False)
class Impact(FrozenArrays):
    """Robot just after an instantaneous impact; `Motion.then` appends the impact to a motion.

    Attributes
    ----------
    robot : Robot
        The robot after the impact, which can be linearised, controlled and simulated.
    q, v : ndarray (nq,), (nv,)
        Configuration and velocity of this robot just after the impact.
    impulse : ndarray (k,)
        For `jam`, the impulse on each jammed joint: [N m s] for a revolute joint, [N s] for a
        prismatic joint. For `capture`, see `Capture`.
    energy_lost : float
        Kinetic energy lost in the impact [J], never negative.
    momentum : ndarray (6,)
        Total momentum before the impact: linear [N s], then angular [N m s] about the world's
        origin.
    momentum_after : ndarray (6,)
        Total momentum after the impact, equal to `momentum` to machine precision, unless a
        constraint holds a frame in inertial space.
    event : str
        Short description of the event.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"joint_1": 0.2})
    >>> jammed = fflin.jam(robot, "joint_1", v=spin)
    >>> bool(abs(jammed.momentum_after - jammed.momentum).max() < 1e-12), jammed.event
    (True, 'joint_1 jammed')
    """

    robot: Robot
    q: Array
    v: Array
    impulse: Array
    energy_lost: float
    momentum: Array
    momentum_after: Array
    event: str
    # Robot, configuration and velocity just before the impact.
    _before: tuple[Robot, Array, Array] = field(kw_only=True)
    # units of the impulses of `jam`
    _units: tuple[str, ...] = field(default=(), kw_only=True)

    def __repr__(self) -> str:
        return (
            f"{type(self).__name__}('{self.robot.name}', {self.energy_lost:.4g} J lost)"
        )

    def __str__(self) -> str:
        return folded([f"{self.robot.name}, {self.robot.n} joints: {self.summary}"])

    def _repr_html_(self) -> str:
        return html.result_card(self, html.paragraph(self.summary))

    @property
    def summary(self) -> str:
        """One-line summary of the event, its impulse and the lost energy."""
        impulses = zip(np.abs(self.impulse).tolist(), self._units, strict=True)
        value, unit = max(impulses, default=(0.0, "N m s"))
        return f"{self.event}: largest impulse {value:.4g} {unit}, {self.energy_lost:.4g} J lost"


def jam(
    robot: Robot,
    joints: str | Sequence[str],
    *,
    q: Array | None = None,
    v: Array | None = None,
) -> Impact:
    r"""Stop joints or wheels instantly and permanently at their present positions.

    The other joints are free during the impact. The velocity :math:`\nu_+` just after the impact
    satisfies :math:`M_+ \nu_+ = G^T M \nu`, see (13.1) of docs/derivation.md. M and :math:`M_+` are
    the inertia matrices before and after the impact, and :math:`\nu` is the velocity before the
    impact. G is the Jacobian that maps velocities of the jammed robot to velocities of the robot
    before the impact. Linear and angular momentum are conserved.

    The constraints of the robot remain closed during the impact. If one of them holds a frame in
    inertial space, its impulse changes the momentum. A constraint is removed if its frames are on
    one body after the impact, because all joints of its loop are jammed.

    If a motor fails but its joint still moves freely, use ``robot.replace(passive=[joint])``
    instead of `jam`.

    Parameters
    ----------
    robot : Robot
    joints : str or sequence of str
        Names or patterns of the joints to jam. Mimic joints of a jammed joint are also jammed.
    q, v : array_like (nq,), (nv,), optional
        Configuration and velocity just before the impact; neutral and at rest by default.

    Returns
    -------
    Impact
        Result of the impact. The jammed joints of `Impact.robot` are welded and have no inputs.

    Raises
    ------
    ConstraintError
        If q or v violates a constraint of the robot.
    UnknownNameError
        If a name or pattern in `joints` matches no joint.
    InputError
        If one of these conditions is true:

        - an argument has a wrong size or value;
        - `joints` is empty;
        - `joints` names a mode of a flexible appendage, which cannot jam;
        - the jammed robot would have no inputs.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> spin = fflin.velocity(robot, {"joint_1": 0.2})
    >>> jammed = fflin.jam(robot, "joint_1", v=spin)
    >>> jammed.robot.joint_names, jammed.energy_lost > 0
    (('joint_2', 'joint_3'), True)
    """
    state = StateMap(robot)
    keys = [joints] if isinstance(joints, str) else joints
    if (
        not isinstance(keys, Sequence)
        or not keys
        or not all(isinstance(k, str) for k in keys)
    ):
        raise InputError(f"joints is {joints!r}, expected names of joints")
    modes = {joint.name for joint in robot.modes}
    stoppable = [name for name in robot.joint_names if name not in modes]
    named = by_joint(dict.fromkeys(keys), stoppable, robot.joint)
    if mode := next((name for name in named if name in modes), None):
        raise InputError(
            f"'{mode}' is a mode of a flexible appendage or of slosh, which cannot jam; name "
            "joints or wheels"
        )
    q, v = state_before(robot, q, v)
    at = {name: robot.joint(name).value(q) for name in named}
    looping = _without_rigid_loops(robot, at) if robot.constraints else robot
    left = welded(looping, at)
    hit, forces = struck(left, [(robot, q, v)], "", f"{', '.join(at)} jammed")
    stopped = [6 + robot.joint_names.index(name) for name in at]
    change = -hit.impulse
    if left.constraints:
        change -= Constraints(looping).jacobian(q).T @ forces
    units = tuple(f"{robot.joint(name).force_unit} s" for name in at)
    return replace(hit, impulse=state.forces(change)[stopped], _units=units)


def state_before(robot: Robot, q: Array | None, v: Array | None) -> tuple[Array, Array]:
    """Return q (nq,) and v (nv,) before an impact: neutral and zero by default.

    Raise `ConstraintError` if a robot with constraints cannot reach them.
    """
    q = robot.neutral() if q is None else robot.checked_configuration(q)
    v = np.zeros(robot.nv) if v is None else robot.checked_velocity(v)
    if robot.constraints:
        return _on_constraints(robot, q, v)
    return q, v


def _on_constraints(robot: Robot, q: Array, v: Array) -> tuple[Array, Array]:
    """Return q (nq,) and v (nv,) on the constraints of a robot, or raise `ConstraintError`."""
    closure = Closure(StateMap(robot))
    q = closure.configuration(q)
    return q, closure.velocity(q, v)


def impulses_of(closure: Closure, forces: Array) -> list[Array]:
    """Return the impulse (6,) on the frame of each constraint from the impulses of the rows."""
    return [pair.selected.T @ forces[pair.rows] for pair in closure.constraints.pairs]


def _without_rigid_loops(robot: Robot, stopped: Collection[str]) -> Robot:
    """Return the robot without constraints whose frames are on one body if joints are stopped.

    The result has no chosen independent coordinates, because fewer of them remain.
    """
    rigid = []
    for item in robot.constraints:
        if item.to is None:
            continue
        paths = [
            set(robot.model.supports[find_frame(robot.model, name).joint])
            for name in item.frames
        ]
        between = paths[0] ^ paths[1]
        if all(_is_stopped(robot, index, stopped) for index in between):
            rigid.append(item.title)
    kept = tuple(item for item in robot.constraints if item.title not in rigid)
    outputs = tuple(
        output
        for output in robot.outputs
        if not (isinstance(output, ConstraintForce) and output.name in rigid)
    )
    return replace(robot, constraints=kept, outputs=outputs, independent=())


def _is_stopped(robot: Robot, index: int, stopped: Collection[str]) -> bool:
    """Return whether the joint with a Pinocchio index is stopped, or follows a stopped joint."""
    name = robot.model.names[index]
    leaders = {x.joint.name: x.leader.name for x in robot.followers}
    return leaders.get(name, name) in stopped


def struck(
    whole: Robot, parts: Sequence[tuple[Robot, Array, Array]], prefix: str, event: str
) -> tuple[Impact, Array]:
    """Return the impact that turns the robots in `parts` into the robot `whole`.

    Each part is (robot, q, v), with q and v just before the impact. The velocity just after the
    impact solves (13.1). For each part, the `impulse` of the result contains the vector
    M (v_before - v_after) in Pinocchio's order, which is minus the generalised impulse on the part.
    In `whole`, the joint names of the second part begin with `prefix`.

    The second result is the impulse (rows,) of each row of the constraints of `whole`.
    """
    state = StateMap(whole)
    q = whole.neutral()
    local = pin.ReferenceFrame.LOCAL
    sizes = [robot.nv for robot, *_ in parts]
    G, M = np.zeros((sum(sizes), whole.nv)), np.zeros((sum(sizes), sum(sizes)))
    q[:7] = parts[0][1][:7]
    at = 0
    for robot, own_q, _ in parts:
        rows = G[at : at + robot.nv]
        start = f"{prefix}." if at else ""
        M[at : at + robot.nv, at : at + robot.nv] = inertia_at(robot, own_q)
        for name in list(robot.model.names)[ROOT + 1 :]:
            if whole.model.existJointName(start + name):
                part_joint = joint_called(robot, name)
                whole_joint = joint_called(whole, start + name)
                q[whole_joint.idx_q : whole_joint.idx_q + whole_joint.nq] = own_q[
                    part_joint.idx_q :
                ][: part_joint.nq]
                rows[part_joint.idx_v, whole_joint.idx_v] = 1.0
        rows[:6, :6] = np.eye(6)
        if at:
            frame = whole.model.getFrameId(prefix, pin.FrameType.BODY)
            data = whole.create_data()
            rows[:6] = pin.computeFrameJacobian(whole.model, data, q, frame, local)
        at += robot.nv
    spread = np.eye(whole.nv) if state.S is None else state.S
    reduced = G @ spread
    before: Array = np.concatenate([own_v for *_, own_v in parts])
    momenta = reduced.T @ (M @ before)
    v: Array = spread @ np.linalg.solve(reduced.T @ M @ reduced, momenta)
    forces: Array = np.zeros(0)
    if whole.constraints:
        # Two orthogonal projections, the second on a part of the space of the first, are one
        # projection on that part.
        closure = Closure(state)
        q = closure.configuration(q)
        v, forces = closure.after_impact(q, v)
    jump = before - G @ v
    hit = Impact(
        robot=whole,
        q=q,
        v=v,
        impulse=M @ jump,
        energy_lost=0.5 * float(jump @ M @ jump),
        momentum=np.sum([momentum_of(*part) for part in parts], axis=0),
        momentum_after=momentum_of(whole, q, v),
        event=event,
        _before=parts[0],
    )
    return hit, forces


def inertia_at(robot: Robot, q: Array) -> Array:
    """Return the joint-space inertia M (nv, nv) at a configuration, for Pinocchio's v."""
    return np.asarray(pin.crba(robot.model, robot.create_data(), q.copy()))


def momentum_of(robot: Robot, q: Array, v: Array) -> Array:
    """Return the momentum (6,) in world axes: linear, then angular about the world's origin."""
    data = robot.create_data()
    pin.computeCentroidalMomentum(robot.model, data, q, v)
    linear = data.hg.linear
    angular = data.hg.angular + np.cross(data.com[0], data.hg.linear)
    return np.concatenate((linear, angular))


def joint_called(robot: Robot, name: str) -> pin.JointModel:
    """Return the joint of a given name from the Pinocchio model of a robot."""
    return robot.model.joints[robot.model.getJointId(name)]


@dataclass(frozen=True, eq=False, repr=False)
class Capture(Impact):
    """Result of `capture`: the robot combined with its payload just after the grasp.

    A `Capture` also has the attributes of `Impact`.

    Attributes
    ----------
    impulse : ndarray (6 + 6 k,)
        Impulse of the payload on the robot at the grasp, in the axes of the payload's frame: linear
        [N s], then angular [N m s] about the origin of this frame. Then follows the impulse (6,) on
        the `frame` of each of the k constraints in `hold`, as in `latch`. If constraints are
        redundant, these impulses are not determinate, and the smallest ones are returned.
    payload : Robot
        The grasped payload as a separate robot. The configuration and velocity of the payload just
        before the impact are ``payload_q`` (nq,) and ``payload_v`` (nv,).
    prefix : str
        Name of the payload's frame in the combined robot.

    Examples
    --------
    >>> import pinocchio as pin
    >>> robot = fflin.load("planar_detumble")
    >>> ballast = pin.Inertia.FromSphere(5.0, 0.1)
    >>> caught = fflin.capture(robot, "hand", ballast, payload_v=[0.1, 0, 0, 0, 0, 0])
    >>> bool(abs(caught.momentum_after - caught.momentum).max() < 1e-9)
    True
    """

    payload: Robot
    payload_q: Array
    payload_v: Array
    prefix: str

    @property
    def summary(self) -> str:
        """One-line summary of the event, its impulse and the lost energy."""
        force, torque = (np.linalg.norm(half) for half in np.split(self.impulse[:6], 2))
        return (
            f"{self.event}: impulse at the grasp {force:.4g} N s and {torque:.4g} N m s, "
            f"{self.energy_lost:.4g} J lost"
        )


def capture(
    robot: Robot,
    frame: str,
    payload: pin.Inertia | Robot,
    *,
    q: Array | None = None,
    v: Array | None = None,
    placement: pin.SE3 | None = None,
    payload_q: Array | None = None,
    payload_v: Array | None = None,
    prefix: str = "payload",
    hold: Constraint | Sequence[Constraint] = (),
) -> Capture:
    r"""Grasp a payload rigidly, instantly and permanently.

    The joints are free during the impact, because the finite torques of motors have no effect in
    an instant. The velocity :math:`\nu_+` just after the impact solves
    :math:`M_+ \nu_+ = G^T \mathrm{diag}(M, M_p) (\nu_-, V_p)`. Just before the impact,
    :math:`\nu_-` is the velocity of the robot, :math:`V_p` is the velocity of the payload, and M
    and :math:`M_p` are their inertia matrices. :math:`M_+` is the inertia matrix of the combined
    robot. G is the Jacobian that maps the velocity of the combined robot to the velocities of robot
    and payload.

    The solution projects the velocities just before the impact onto the motions that the rigid
    grasp permits. The projection is orthogonal with respect to the inertia matrix. The impact
    conserves linear and angular momentum.

    The constraints of the robot and of a payload remain closed during the impact, and so do the
    constraints in `hold`. Constraints of the payload are named PREFIX.NAME. If a constraint holds a
    frame in inertial space, its impulse changes the momentum.

    Parameters
    ----------
    robot : Robot
    frame : str
        Name of the grasping frame.
    payload : pin.Inertia or Robot
        The inertia of a rigid body in the payload's frame, or a robot that is grasped at its base.
        If the payload is a robot, its joints keep their springs and dampers but lose their motors.
    q, v : array_like (nq,), (nv,), optional
        Configuration and velocity of the robot just before the impact; neutral and at rest by
        default.
    placement : pin.SE3, optional
        Placement of the payload's frame in the grasping frame; the identity by default.
    payload_q : array_like (nq,), optional
        Configuration of a payload with joints; neutral by default. The base pose in `payload_q`
        is ignored, because `placement` defines the pose.
    payload_v : array_like (6,) or (nv,), optional
        Velocity of the payload; at rest by default. The first six entries are the twist of the
        payload's frame in its own axes (Pinocchio's LOCAL): linear [m/s], then angular [rad/s].
        The remaining entries are the joint rates of the payload.
    prefix : str
        Name of the payload's frame. The payload's joints and links are named PREFIX.NAME.
    hold : Weld, Hinge, Spherical, or a sequence of them, optional
        Constraints that close at the instant of the grasp, for example a second gripper or a latch.
        They connect frames of the combined robot, such as `prefix` and PREFIX.NAME of the payload.
        A constraint without a placement holds its frames in the pose that they have at q.

    Returns
    -------
    Capture

    Raises
    ------
    UnknownNameError
        If the robot has no frame with the given name.
    ConstraintError
        If q, v or the payload violates a constraint, or the frames of `hold` are too far from their
        placement.
    InputError
        If one of these conditions is true:

        - an argument has a wrong size or value;
        - the payload's inertia is not physically realisable;
        - the robot already has names with this prefix;
        - robot and payload have different gravity or orbits;
        - a wheel of the payload has momentum but no inertia.
    ModelError
        If the Pinocchio model of the robot or of the payload was modified after its creation.

    References
    ----------
    Y. Umetani and K. Yoshida, IEEE Trans. Robotics and Automation 5(3), 1989, for a robot with free
    joints. The impact itself is the perfectly inelastic collision of two bodies.

    Examples
    --------
    >>> import pinocchio as pin
    >>> robot = fflin.load("planar_detumble")
    >>> ball = pin.Inertia.FromSphere(5.0, 0.1)
    >>> caught = fflin.capture(robot, "hand", ball, payload_v=[0.01, 0, 0, 0, 0, 0.02])
    >>> caught.robot.n, caught.energy_lost > 0
    (3, True)
    """
    instance("robot", robot, Robot, "a fflin.Robot").require_unchanged()
    refuse_elliptic(robot, "captures")
    if isinstance(payload, pin.Inertia):
        alone = body_alone(payload, prefix)
        other = replace(alone, gravity=robot.gravity, orbit=robot.orbit)
    else:
        instance(
            "payload", payload, Robot, "a pin.Inertia or a fflin.Robot"
        ).require_unchanged()
        # a copy, since the payload may be the same object as the robot
        other = replace(payload)
        _require_same_environment(robot, other)
    if other.stored_momentum:
        raise InputError(
            "a wheel of the payload has a momentum but no inertia, so its momentum would be "
            "lost; give the wheel an inertia, and its speed in payload_v"
        )
    at = (
        pin.SE3.Identity()
        if placement is None
        else checked_placement("placement", placement)
    )
    q, v = state_before(robot, q, v)
    holding = checked_constraints(hold, "hold")
    joint, on = find_frame(robot.model, frame)
    data = robot.create_data()
    pin.forwardKinematics(robot.model, data, q)
    other_q, other_v = _beside(other, data.oMi[joint] * on * at, payload_q, payload_v)
    if other.constraints:
        other_q, other_v = _on_constraints(other, other_q, other_v)
    whole = _held(joined(robot, frame, other, at, prefix), other, prefix, holding)
    parts = [(robot, q, v), (other, other_q, other_v)]
    hit, forces = struck(
        whole, parts, prefix, f"{prefix} of {other.mass:.6g} kg caught"
    )
    impulse = hit.impulse[robot.nv : robot.nv + 6]
    impulses = [impulse]
    if whole.constraints:
        closure = Closure(StateMap(whole))
        impulses = [impulse + _impulse_on(prefix, closure, hit.q, forces)]
        titles = [item.title for item in whole.constraints]
        held = dict(zip(titles, impulses_of(closure, forces), strict=True))
        impulses += [held[item.title] for item in holding]
    of_impact = vars(hit) | {"impulse": np.concatenate(impulses)}
    return Capture(
        **of_impact, payload=other, payload_q=other_q, payload_v=other_v, prefix=prefix
    )


def _held(
    whole: Robot, payload: Robot, prefix: str, holding: Sequence[Constraint]
) -> Robot:
    """Return the robot `whole`, which has a payload, with more constraints.

    These are the constraints of the payload, with the names of its frames in `whole`, and the
    constraints `holding`.
    """
    of_payload = [_renamed(item, prefix) for item in payload.constraints]
    if not (of_payload or holding):
        return whole
    constraints = [*whole.constraints, *of_payload, *holding]
    return whole.replace(constraints=constraints, independent=[])


def _renamed(constraint: Constraint, prefix: str) -> Constraint:
    """Return a constraint of a payload, with the names that its frames have after the grasp."""
    to = None if constraint.to is None else f"{prefix}.{constraint.to}"
    return replace(
        constraint,
        frame=f"{prefix}.{constraint.frame}",
        to=to,
        name=f"{prefix}.{constraint.title}",
    )


def _impulse_on(prefix: str, closure: Closure, q: Array, forces: Array) -> Array:
    """Return the impulse (6,) of constraints on a payload, in the axes of the payload's frame.

    `forces` (rows,) are the impulses of the rows. A constraint between two frames of the payload
    does not contribute.
    """
    model = closure.state.robot.model
    data = model.createData()
    pin.forwardKinematics(model, data, q)
    joint, on = find_frame(model, prefix)
    payload = data.oMi[joint] * on
    total = pin.Force.Zero()
    for pair, impulse in zip(
        closure.constraints.pairs, impulses_of(closure, forces), strict=True
    ):
        item = pair.constraint
        first = data.oMi[pair.first.joint] * pair.first.placement
        wrench = payload.actInv(first).act(pin.Force(impulse))
        if _is_part(item.frame, prefix):
            total += wrench
        if item.to is not None and _is_part(item.to, prefix):
            total -= wrench
    impulse_on_payload: Array = total.vector
    return impulse_on_payload


def _is_part(frame: str, prefix: str) -> bool:
    """Return whether a frame of the combined robot is fixed to the payload or to its links."""
    return frame == prefix or frame.startswith(f"{prefix}.")


def _require_same_environment(robot: Robot, payload: Robot) -> None:
    """Raise `InputError` if two robots differ in gravity or orbit."""
    for name in ("gravity", "orbit"):
        robot_value, payload_value = getattr(robot, name), getattr(payload, name)
        if robot_value != payload_value:
            raise InputError(
                f"the robot's {name} is {robot_value}, but the payload's is {payload_value}; give "
                f"both the same {name}"
            )


def _beside(
    other: Robot, at: pin.SE3, q: Array | None, v: Array | None
) -> tuple[Array, Array]:
    """Return the checked configuration and velocity of a payload, with its base placed at `at`.

    `at` is a placement in the world. If q is None, the joints are at their neutral positions. If v
    is None, the payload is at rest. If v is a twist (6,), the joints are at rest.
    """
    configuration = (
        other.neutral() if q is None else other.checked_configuration(q).copy()
    )
    root = other.model.jointPlacements[ROOT]
    configuration[:7] = pin.SE3ToXYZQUAT(root.actInv(at))
    if v is None:
        return configuration, np.zeros(other.nv)
    if other.n and dimension("payload_v", v) == 1 and len(v) == 6:
        v = np.concatenate(
            (vector("payload_v", v, 6, "a twist"), np.zeros(other.nv - 6))
        )
    expected = "the twist (linear, angular) of the payload"
    if other.n:
        expected += ", and its joints"
    v = vector("payload_v", v, other.nv, expected)
    return configuration, other.checked_velocity(v)
