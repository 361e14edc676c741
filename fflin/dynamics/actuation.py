"""Generalised forces of the inputs: columns of the input matrix, and wrenches on links."""

import numpy as np
import pinocchio as pin

import fflin.robot.inputs as kinds
from fflin.base.errors import InputError
from fflin.base.validation import Array, Indices
from fflin.dynamics.coordinates import ANGULAR, LINEAR, Chart
from fflin.dynamics.state import StateMap
from fflin.robot.joints import find_frame

_LOCAL = pin.ReferenceFrame.LOCAL


class Actuation:
    """Inputs of a robot, with their names, units, columns and wrenches."""

    def __init__(self, state: StateMap) -> None:
        robot, nv = state.robot, 6 + state.robot.n
        self._state, self._model = state, robot.model
        names: list[str] = []
        units: list[str] = []
        groups: list[str] = []
        columns: list[Array] = []
        held: list[slice] = []
        # Thrusters and wheels without a joint of their own. {joint on which they are mounted:
        # (index of the input, wrench (6,) of a unit input in the joint's frame)}.
        carried: dict[int, list[tuple[int, Array]]] = {}
        identity = np.eye(nv)
        for item, own in kinds.named_inputs(robot.inputs):
            at, unit = len(columns), item.UNIT
            if isinstance(item, kinds.BaseTorque | kinds.BaseForce):
                torque = isinstance(item, kinds.BaseTorque)
                rows = ANGULAR if torque else LINEAR
                columns += list(identity[rows])
                if state.axes[0 if torque else 1]:
                    held.append(slice(at, at + 3))
            elif isinstance(item, kinds.JointTorque):
                index = robot.joints.index(robot.joint(item.joint))
                unit = robot.joints[index].force_unit
                columns.append(identity[6 + index])
            elif isinstance(item, kinds.ReactionWheel) and item.inertia:
                columns.append(identity[6 + robot.joint_names.index(own[0])])
            else:
                assert isinstance(item, kinds.WrenchInput)
                joint, placement = find_frame(robot.model, item.frame)
                wrench = np.array(placement.act(pin.Force(item.wrench)).vector)
                carried.setdefault(joint, []).append((at, wrench))
                columns.append(np.zeros(nv))
            names += own
            units += [unit] * len(own)
            groups += [item.GROUP] * len(own)
        if len({*names}) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"two inputs are named '{twice}'; give one of them another name")
        # In linear models, the same attributes have the names `input_names` and `input_units`.
        self.names = self.input_names = tuple(names)
        self.units = self.input_units = tuple(units)
        # {group: indices of its inputs}. The groups are tau_b, F_b, tau_m, thrust and wheel, in
        # the order in which they first appear.
        self.groups: dict[str, Indices] = {}
        for group in dict.fromkeys(groups):
            self.groups[group] = np.flatnonzero(np.array(groups) == group)
        # Slices of three inputs that form a torque or force on the base in reference axes.
        self.held = tuple(held)
        # Generalised force (6 + n, nu) per unit of each input; zero for the inputs whose
        # generalised force depends on the configuration.
        self.fixed: Array = np.column_stack(columns) if columns else np.zeros((nv, 0))
        # Whether the inputs are tau_b, F_b and all joint torques, so that `fixed` is the identity.
        self.default = self.fixed.shape == (nv, nv) and bool((self.fixed == identity).all())
        # (joint, indices of the inputs mounted on it, their wrenches (6, ..) in its frame).
        self.wrench_columns: list[tuple[int, Indices, Array]] = []
        self._of_carried: list[int] = []
        for joint, items in carried.items():
            places, wrenches = zip(*items, strict=True)
            self.wrench_columns.append((joint, np.array(places), np.column_stack(wrenches)))
            self._of_carried += places
        self.carried = bool(carried)  # whether columns depend on the configuration

    def columns(self, data: pin.Data, q: Array) -> Array:
        """Return B_u (6 + n, nu), the generalised force in base axes per unit input (6.1)."""
        if not self.carried:
            return self.fixed
        columns = self.fixed.copy()
        pin.computeJointJacobians(self._model, data, q)
        forces = [
            pin.getJointJacobian(self._model, data, joint, _LOCAL).T.dot(wrenches)
            for joint, _, wrenches in self.wrench_columns
        ]
        columns[:, self._of_carried] = self._state.forces(np.concatenate(forces, axis=1))
        return columns

    def in_base_axes(self, chart: Chart, u: Array) -> Array:
        """Rotate the reference-frame wrenches in u (.., nu) to base axes."""
        if not self.held:
            return u
        return chart.to_base(self.held, u[..., None])[..., 0]

    def turn_columns(self, chart: Chart, by_u: Array) -> None:
        """Convert derivatives (.., k, nu) over inputs in base axes to derivatives over u (4.7)."""
        chart.turn_columns(self.held, by_u)

    def wrenches(self, u: Array) -> pin.StdVec_Force | None:
        """Return each joint's wrench of thrusters and wheels in its frame; None without any."""
        if not self.carried:
            return None
        external = pin.StdVec_Force(self._model.njoints, pin.Force.Zero())
        for joint, inputs, wrenches in self.wrench_columns:
            external[joint] = pin.Force(wrenches.dot(u.take(inputs)))
        return external

    def torques(self, u: Array) -> Array:
        """Return the generalised forces (6 + n,) of the inputs that are not in `wrenches`."""
        return self.fixed @ u
