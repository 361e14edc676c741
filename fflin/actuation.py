"""How inputs act: the columns that take u to generalised forces, and the wrenches on links."""

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from fflin.errors import InputError, unknown
from fflin.inputs import BaseForce, BaseTorque, JointTorque, Thruster
from fflin.model import ROOT, Robot
from fflin.state import ANGULAR, LINEAR, Chart, StateMap
from fflin.validation import Array


class Held(NamedTuple):
    """Three inputs that are a vector on the base, held in reference axes."""

    columns: slice
    rows: slice


class Actuation:
    """The inputs of a robot, prepared.

    Attributes
    ----------
    names, units : tuple of str
        Of the nu inputs.
    groups : dict
        {name: slice} of the inputs by kind: tau_b, F_b, tau_m, thrust, in order of appearance.
    default : bool
        Whether they are tau_b, F_b and every joint's, so that the columns are the identity.
    held : tuple of Held
        What the frame holds in reference axes.
    """

    def __init__(self, state: StateMap) -> None:
        robot = state.robot
        self._state = state
        self._model = robot.model
        nv = 6 + robot.n
        names: list[str] = []
        units: list[str] = []
        kinds: list[str] = []
        columns: list[Array] = []
        held: list[Held] = []
        # Thrusters by the Pinocchio joint that carries them: (input, wrench in its frame).
        carried: dict[int, list[tuple[int, Array]]] = {}
        identity = np.eye(nv)
        for item in robot.inputs:
            at = len(names)
            if isinstance(item, BaseTorque | BaseForce):
                torque = isinstance(item, BaseTorque)
                group, rows = ("tau_b", ANGULAR) if torque else ("F_b", LINEAR)
                names += [f"{group}.{axis}" for axis in "xyz"]
                units += ["N m" if torque else "N"] * 3
                kinds += [group] * 3
                columns += list(identity[rows])
                if state.axes[0 if torque else 1]:
                    held.append(Held(slice(at, at + 3), rows))
            elif isinstance(item, JointTorque):
                joint = robot.joint(item.joint)
                names.append(f"tau_m.{joint.name}")
                units.append("N" if joint.prismatic else "N m")
                kinds.append("tau_m")
                columns.append(identity[6 + robot.joints.index(joint)])
            else:
                joint_index, wrench = _wrench(robot, item)
                carried.setdefault(joint_index, []).append((at, wrench))
                number = 1 + kinds.count("thrust")
                names.append(item.name or f"thruster_{number}")
                units.append("N")
                kinds.append("thrust")
                columns.append(np.zeros(nv))
        twice = [name for index, name in enumerate(names) if name in names[:index]]
        if twice:
            raise InputError(f"two inputs are named '{twice[0]}'; give one of them another name")
        self.names, self.units = tuple(names), tuple(units)
        self.groups = {
            kind: np.flatnonzero([kind == other for other in kinds])
            for kind in dict.fromkeys(kinds)
        }
        self.held = tuple(held)
        self._fixed = np.column_stack(columns) if columns else np.zeros((nv, 0))
        self.default = self._fixed.shape == (nv, nv) and bool((self._fixed == identity).all())
        self._carried = [
            (joint, np.array([at for at, _ in items]), np.column_stack([w for _, w in items]))
            for joint, items in carried.items()
        ]

    @property
    def carried(self) -> bool:
        """Whether an input's column depends on the configuration."""
        return bool(self._carried)

    def columns(self, data: pin.Data, q: Array) -> Array:
        """Return the generalised force (6 + n, nu), in base axes, of a unit of each input.

        Inputs that are held in reference axes are counted as if they were held in base axes.
        """
        if not self._carried:
            return self._fixed
        columns = self._fixed.copy()
        pin.computeJointJacobians(self._model, data, q)
        for joint, inputs, wrenches in self._carried:
            jacobian = pin.getJointJacobian(self._model, data, joint, pin.ReferenceFrame.LOCAL)
            columns[:, inputs] = self._state.forces(jacobian.T @ wrenches)
        return columns

    def in_base_axes(self, chart: Chart, u: Array) -> Array:
        """Return u (nu,) with what is held in reference axes in base axes."""
        if not self.held:
            return u
        u = u.copy()
        for held in self.held:
            u[held.columns] = chart.R.T @ u[held.columns]
        return u

    def wrenches(self, u: Array) -> pin.StdVec_Force | None:
        """Return the wrench of the thrusters on every joint, in its frame, where there are any."""
        if not self._carried:
            return None
        external = pin.StdVec_Force(self._model.njoints, pin.Force.Zero())
        for joint, inputs, wrenches in self._carried:
            external[joint] = pin.Force(wrenches @ u[inputs])
        return external

    def torques(self, u: Array) -> Array:
        """Return the generalised forces (6 + n,) in base axes of all but the thrusters."""
        return self._fixed @ u


def _wrench(robot: Robot, thruster: Thruster) -> tuple[int, Array]:
    """Return the joint that carries a thruster and its wrench (6,) per newton in that frame."""
    model = robot.model
    if not model.existFrame(thruster.frame):
        frames = [frame.name for frame in model.frames.tolist() if frame.parentJoint >= ROOT]
        raise unknown("frame", thruster.frame, frames)
    frame = model.frames[model.getFrameId(thruster.frame)]
    force = frame.placement.rotation @ np.array(thruster.direction)
    point = frame.placement.act(np.array(thruster.position))
    return frame.parentJoint, np.concatenate((force, np.cross(point, force)))
