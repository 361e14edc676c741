"""The equations: A and B about any point, from CRBA's M and the derivatives of RNEA."""

from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from fflin import __version__
from fflin.certificate import certify
from fflin.inertia import Inertia, inertia_matrix
from fflin.linear_model import LinearModel
from fflin.model import ROOT, Robot
from fflin.rotation import skew
from fflin.state import ANGULAR, LINEAR, Chart, Frame, StateMap, wrench_names, wrench_units
from fflin.validation import Array, vector

_STANDING = Chart(np.zeros(3), 1.0, np.eye(3))


class Linearizer:
    r"""Linearise one robot many times; what does not change is prepared once.

    At rest, with N = blkdiag(E3/2, E3, En) and M the joint-space inertia in state order,

    .. math::
        A = \begin{bmatrix} 0 & N \\ 0 & 0 \end{bmatrix}, \qquad
        B = \begin{bmatrix} 0 \\ M^{-1} \end{bmatrix}.

    Elsewhere :math:`\dot\nu = M^{-1}(\tau - b(q, \nu))` is differentiated in base axes as
    :math:`-M^{-1}\,\partial\,\mathrm{rnea}(q, \nu, \dot\nu)` and carried to the chart and frame.
    The dynamics do not depend on the base's position and linear velocity (Galilei), so they are
    evaluated without them: an orbit costs no digits.

    Parameters
    ----------
    robot : Robot
    frame : {"hybrid", "local", "world"}
        Axes of the base's velocities and wrenches, see `StateMap`.
    reference : pin.SE3, optional
        Placement that attitude and position are relative to; by default the base's own at each
        point, so that the model is taken about the pose where the robot stands.

    Raises
    ------
    InputError
        If the frame is unknown or the reference is not a pin.SE3.
    ModelError
        If Pinocchio's Data for the robot would pass 1 GiB.

    References
    ----------
    Y. Yang, J. Aerospace Engineering 25(3), 2012. J. Carpentier and N. Mansard, Analytical
    derivatives of rigid body dynamics algorithms, Robotics: Science and Systems, 2018.
    """

    def __init__(
        self, robot: Robot, *, frame: Frame = "hybrid", reference: pin.SE3 | None = None
    ) -> None:
        self.robot = robot
        self._map = StateMap(robot, reference=reference, frame=frame)
        self._own_reference = reference is None
        self._data = robot.create_data()
        self._inertia = Inertia(self._map, self._data)
        nv, nx = 6 + robot.n, self._map.nx
        self._nv = nv
        self._zero_v, self._zero_u, self._zero_x = (
            _frozen(np.zeros(size)) for size in (robot.nv, nv, nx)
        )
        self._rates = np.array([0.5] * 3 + [1.0] * (nv - 3))  # the diagonal of N
        self._A_rest = _frozen(
            np.block([[np.zeros((nv, nv)), np.diag(self._rates)], [np.zeros((nv, nx))]])
        )
        self._shape_B, self._lower = (nx, nv), slice(nv, nx)
        self._q_m = self._map.groups.q_m if robot.n else None
        self._root_at_origin = robot.model.jointPlacements[ROOT].isIdentity(0.0)
        self._reference = _frozen(pin.SE3ToXYZQUAT(self._map.reference))
        self._common = self._common_fields()
        self._at_rest_fields = self._common | {
            "A": self._A_rest,
            "f0": self._zero_x,
            "x0": self._zero_x,
            "y0": self._zero_x,
            "u0": self._zero_u,
            "v": self._zero_v,
        }

    def __call__(
        self, q: Array | None = None, v: Array | None = None, u: Array | None = None
    ) -> LinearModel:
        """Linearise about a point.

        Parameters
        ----------
        q : array_like (nq,), optional
            Configuration in Pinocchio's order; neutral by default.
        v : array_like (nv,), optional
            Velocity in Pinocchio's order; at rest by default.
        u : array_like (6 + n,), optional
            Input (tau_b [N m], F_b [N], tau_m [N m|N]) in the frame's axes; zero by default.

        Returns
        -------
        LinearModel

        Raises
        ------
        InputError
            If a size is wrong or an entry is not finite or not of unit length.
        ChartError
            If the base is turned by pi from the reference.
        SingularInertiaError
            If a joint moves no mass.
        """
        robot = self.robot
        q = robot.neutral() if q is None else robot.checked_configuration(q).copy()
        q.setflags(write=False)
        if v is None and u is None and self._own_reference:
            return self._at_rest(q)
        if v is not None:
            v = _frozen(robot.checked_velocity(v).copy())
        if u is not None:
            u = _frozen(vector("u", u, self._nv, "an input (tau_b, F_b, tau_m)").copy())
        return self._anywhere(q, self._zero_v if v is None else v, self._zero_u if u is None else u)

    def _at_rest(self, q: Array) -> LinearModel:
        B = np.zeros(self._shape_B)
        self._inertia.invert(q, B[self._lower])
        B.setflags(write=False)
        values = self._at_rest_fields.copy()
        values["B"] = B
        values["q"] = q
        if self._q_m is not None:
            x0 = np.zeros(self._map.nx)
            x0[self._q_m] = self._map.joint_positions(q)
            x0.setflags(write=False)
            values["x0"] = values["y0"] = x0
        values["_reference"] = q[:7] if self._root_at_origin else self._reference_of(q)
        return LinearModel._from_fields(values)

    def _anywhere(self, q: Array, v: Array, u: Array) -> LinearModel:
        state, nv, groups = self._map, self._nv, self._map.groups
        model, data = self.robot.model, self._data
        chart = _STANDING if self._own_reference else state.chart(q)

        # In base axes, and without the base's position and linear velocity: nothing below
        # depends on them, and Pinocchio's derivatives lose digits to both.
        nu, force = state.velocities(v), u
        if chart is not _STANDING:
            force = u.copy()
            state.to_base(chart, force)
        q_still, v_still = q.copy(), v.copy()
        q_still[:3] = v_still[:3] = 0.0
        B = np.zeros(self._shape_B)
        inverse = B[-nv:]
        self._inertia.invert(q_still, inverse)
        bias = state.forces(pin.nonLinearEffects(model, data, q_still, v_still))
        c = inverse.dot(force - bias)
        by_q, by_v, _ = pin.computeRNEADerivatives(model, data, q_still, v_still, state.spread(c))

        A = self._A_rest.copy()
        self._set_kinematics(A, chart, nu)
        lower = A[-nv:]
        lower[:, groups.q_m] = inverse.dot(state.project(by_q)[:, 6:])
        lower[:, -nv:] = inverse.dot(state.project(by_v))
        np.negative(lower, out=lower)
        lower[:, groups.v_b] = 0.0
        self._set_turning(lower, chart, nu, force, c, inverse)
        f0: Array = np.empty(state.nx)
        x0: Array = np.zeros(state.nx)
        np.multiply(nu, self._rates, out=f0[:nv])
        f0[nv:] = c
        if chart is _STANDING:
            x0[groups.q_m] = state.joint_positions(q)
            x0[nv:] = nu
        else:
            x0 = state.to_state(q, v)
            f0[groups.q_b] = chart.Q @ f0[groups.q_b]
            f0[groups.r_b] = chart.R @ f0[groups.r_b]
            for rows in (f0[nv:], lower, lower[:, -nv:].T, inverse, inverse.T):
                state.to_frame(chart, rows)
        for array in (A, B, f0, x0):
            array.setflags(write=False)
        point = {"A": A, "B": B, "f0": f0, "x0": x0, "y0": x0, "u0": u, "q": q, "v": v}
        point["_reference"] = self._reference_of(q)
        return LinearModel._from_fields(self._common | point)

    def _set_turning(
        self, lower: Array, chart: Chart, nu: Array, force: Array, c: Array, inverse: Array
    ) -> None:
        r"""Complete the velocity rows (6 + n, nx) for what is held in which axes.

        `c` (6 + n,) is the acceleration of the base origin and the joints in base axes. A turn
        :math:`\delta\theta` of the base under a vector s held in reference axes changes its base
        components by :math:`[s]_\times \delta\theta`: so the velocities and forces that the
        frame holds in reference axes change, and the accelerations turn back. A v_b in base
        axes has the rate :math:`c - \omega \times v_b` instead, which is left in `c`.
        """
        groups = self._map.groups
        turned_angular, turned_linear = self._map.axes
        w, v = nu[ANGULAR], nu[LINEAR]
        if turned_linear:
            turn = inverse[:, LINEAR].dot(skew(force[LINEAR]))
            turn[LINEAR] -= skew(c[LINEAR])
            if turned_angular:
                turn += lower[:, groups.omega_b].dot(skew(w))
                turn += inverse[:, ANGULAR].dot(skew(force[ANGULAR]))
                turn[ANGULAR] -= skew(c[ANGULAR])
            lower[:, groups.q_b] = turn.dot(chart.J)
        else:
            lower[LINEAR, groups.omega_b] += skew(v)
            turning = skew(w)
            lower[LINEAR, groups.v_b] -= turning
            c[LINEAR] -= turning.dot(v)

    def _set_kinematics(self, A: Array, chart: Chart, nu: Array) -> None:
        """Set what the motion changes in the rows of q_b and r_b; `nu` (6 + n,) in base axes."""
        g, (turned_angular, turned_linear) = self._map.groups, self._map.axes
        w, Q, J, R = nu[ANGULAR], chart.Q, chart.J, chart.R
        slope = -0.5 * skew(w)
        if chart is not _STANDING:
            slope -= np.outer(0.5 * w, chart.q_b / chart.q0)
            A[g.q_b, g.omega_b] = 0.5 * Q @ R.T if turned_angular else 0.5 * Q
        if turned_angular:
            slope += 0.5 * Q.dot(skew(w)).dot(J)
        A[g.q_b, g.q_b] = slope
        if not turned_linear:
            A[g.r_b, g.v_b] = R
            A[g.r_b, g.q_b] = -R.dot(skew(nu[LINEAR])).dot(J)

    def _reference_of(self, q: Array) -> Array:
        if not self._own_reference:
            return self._reference
        if self._root_at_origin:
            return q[:7]
        root = self.robot.model.jointPlacements[ROOT]
        return _frozen(pin.SE3ToXYZQUAT(root * pin.XYZQUATToSE3(q[:7])))

    def _common_fields(self) -> dict[str, Any]:
        robot, state = self.robot, self._map
        names, units = wrench_names(robot), wrench_units(robot)
        return {
            "C": _frozen(np.eye(state.nx)),
            "D": _frozen(np.zeros((state.nx, len(names)))),
            "dt": 0.0,
            "state_names": state.names,
            "input_names": names,
            "output_names": state.names,
            "state_units": state.units,
            "input_units": units,
            "output_units": state.units,
            "frame": state.frame,
            "robot": robot.name,
            "urdf_sha256": robot.urdf_sha256,
            "fflin_version": __version__,
            "pinocchio_version": pin.__version__,
            "_inertia": partial(inertia_matrix, robot),
            "_certify": partial(certify, robot),
        }


def linearize(
    robot: Robot,
    q: Array | None = None,
    v: Array | None = None,
    u: Array | None = None,
    *,
    frame: Frame = "hybrid",
    reference: pin.SE3 | None = None,
) -> LinearModel:
    """Linearise a robot about a point; at rest with neutral joints by default.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration in Pinocchio's order, see `configuration`; neutral by default.
    v : array_like (nv,), optional
        Velocity in Pinocchio's order; at rest by default.
    u : array_like (6 + n,), optional
        Input (tau_b [N m], F_b [N], tau_m [N m|N]) in the frame's axes; zero by default.
    frame : {"hybrid", "local", "world"}
        Axes of the base's velocities and wrenches, see `StateMap`.
    reference : pin.SE3, optional
        Placement that attitude and position are relative to; the base's own by default.

    Returns
    -------
    LinearModel

    Raises
    ------
    InputError
        If an argument has a wrong size or value.
    ChartError
        If the base is turned by pi from the reference.
    SingularInertiaError
        If a joint moves no mass.
    ModelError
        If the robot is too large.

    See Also
    --------
    Linearizer : the same, prepared once for many points; the equations stand there.
    """
    return Linearizer(robot, frame=frame, reference=reference)(q, v, u)


def _frozen(array: Array) -> Array:
    array.setflags(write=False)
    return array
