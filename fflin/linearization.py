"""The equations: A and B about any point, from CRBA's M and the derivatives of RNEA."""

from functools import partial
from typing import Any

import numpy as np
import pinocchio as pin

from fflin import __version__
from fflin.certificate import certify
from fflin.errors import SingularInertiaError
from fflin.linear_model import LinearModel
from fflin.model import ROOT, Robot
from fflin.rotation import skew
from fflin.state import ANGULAR, LINEAR, Chart, Frame, StateMap, wrench_names, wrench_units
from fflin.validation import Array, vector

# M_ii (M^-1)_ii is 1 for a decoupled coordinate and grows as it loses inertia of its own; times
# the rounding unit it is the relative error of (M^-1)_ii. Where the sum over the coordinates
# passes this, less than two digits of M^-1 are left.
_LARGEST_COUPLING = 1e-2 / np.finfo(float).eps

_STANDING = Chart(np.zeros(3), 1.0, np.eye(3))


class Linearizer:
    r"""Linearise one robot many times; what does not change is prepared once.

    At rest, with N = blkdiag(E3/2, E3, En) and M the joint-space inertia in state order,

    .. math::
        A = \begin{bmatrix} 0 & N \\ 0 & 0 \end{bmatrix}, \qquad
        B = \begin{bmatrix} 0 \\ M^{-1} \end{bmatrix}.

    Elsewhere :math:`\dot\nu = M^{-1}(\tau - b(q, \nu))` is differentiated in base axes as
    :math:`-M^{-1}\,\partial\,\mathrm{rnea}(q, \nu, \dot\nu)` and carried to the chart and frame.

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
        # A view into Data, which Pinocchio overwrites in place; transposed, it is C-contiguous.
        self._M = self._data.M.T
        self._diagonal = self._M.diagonal()
        nv, nx = robot.model.nv, self._map.nx
        self._zero_v, self._zero_u, self._zero_x = (_frozen(np.zeros(k)) for k in (nv, nv, nx))
        order = self._map.order
        self._state_order = order[:, None] * nv + order  # flat indices into an (nv, nv) array
        self._A_rest = np.zeros((nx, nx))
        self._set_kinematics(self._A_rest, _STANDING, self._zero_v)
        self._A_rest.setflags(write=False)
        self._root_at_origin = robot.model.jointPlacements[ROOT].isIdentity(0.0)
        self._common = self._common_fields()

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
        q = _frozen(
            pin.neutral(robot.model) if q is None else robot.checked_configuration(q).copy()
        )
        if v is None and u is None and self._own_reference:
            return self._at_rest(q)
        v = (
            self._zero_v
            if v is None
            else vector("v", v, robot.model.nv, f"a velocity of '{robot.name}'")
        )
        if u is None:
            u = self._zero_u
        else:
            u = vector("u", u, robot.model.nv, "(tau_b, F_b, tau_m)")
        return self._anywhere(q, _frozen(v.copy()), _frozen(u.copy()))

    def _at_rest(self, q: Array) -> LinearModel:
        B = np.zeros(self._common["D"].shape)
        B[-self.robot.model.nv :] = self._inverse_inertia(q)
        x0 = self._zero_x.copy()
        x0[self._map.groups.q_m] = self._map.joint_positions(q)
        return LinearModel._assemble(
            self._common,
            A=self._A_rest,
            B=_frozen(B),
            M=_frozen(self._M.take(self._state_order)),
            f0=self._zero_x,
            x0=_frozen(x0),
            y0=x0,
            u0=self._zero_u,
            q=q,
            v=self._zero_v,
            _reference=self._reference_of(q),
        )

    def _inverse_inertia(self, q: Array) -> Array:
        """Return M^-1 in state order and base axes; leave M in Data."""
        model, data = self.robot.model, self._data
        pin.crba(model, data, q)
        # The sparse Cholesky factor along the tree. Scaling M by its diagonal beforehand would
        # not change its accuracy: the rounding of Cholesky is invariant under it.
        pin.cholesky.decompose(model, data)
        inverse: Array = pin.cholesky.computeMinv(model, data)
        # Written so that NaN, from a pivot that is zero or negative, fails too.
        if not self._diagonal.dot(inverse.diagonal()) < _LARGEST_COUPLING:
            raise _singular(self.robot, self._M)
        return inverse.take(self._state_order)

    def _anywhere(self, q: Array, v: Array, u: Array) -> LinearModel:
        model, data, nv = self.robot.model, self._data, self.robot.model.nv
        order, groups = self._map.order, self._map.groups
        chart = _STANDING if self._own_reference else self._map.chart(q)

        # Everything in base axes first; the bias by RNEA, its slope by RNEA's derivatives.
        nu, force = v[order], u.copy()
        self._map.to_base(chart, force)
        inverse = self._inverse_inertia(q)
        M = self._M.take(self._state_order)
        acceleration = inverse @ (force - pin.nonLinearEffects(model, data, q, v)[order])
        a = np.empty(nv)
        a[order] = acceleration
        by_q, by_v, _ = pin.computeRNEADerivatives(model, data, q, v, a)

        A = np.zeros((self._map.nx, self._map.nx))
        self._set_kinematics(A, chart, nu)
        lower = A[-nv:]
        # Without gravity the base's pose has no influence in base axes.
        lower[:, groups.q_m] = -inverse @ by_q[order, 6:]
        lower[:, -nv:] = -inverse @ by_v.take(self._state_order)
        rate = self._set_base_columns(A, chart, nu, force, acceleration, inverse)

        f0 = np.concatenate((self._kinematic_rate(chart, nu), rate))
        B = np.zeros(self._common["D"].shape)
        B[-nv:] = inverse
        if chart is not _STANDING:
            self._map.to_frame(chart, lower)
            self._map.to_frame(chart, lower[:, -nv:].T)
            self._map.to_frame(chart, f0[-nv:])
            for symmetric in (B[-nv:], M):
                self._map.to_frame(chart, symmetric)
                self._map.to_frame(chart, symmetric.T)
            x0 = self._map.to_state(q, v)
        else:
            x0 = np.concatenate((np.zeros(6), self._map.joint_positions(q), nu))
        return LinearModel._assemble(
            self._common,
            A=_frozen(A),
            B=_frozen(B),
            M=_frozen(M),
            f0=_frozen(f0),
            x0=_frozen(x0),
            y0=x0,
            u0=u,
            q=q,
            v=v,
            _reference=self._reference_of(q),
        )

    def _set_base_columns(
        self,
        A: Array,
        chart: Chart,
        nu: Array,
        force: Array,
        acceleration: Array,
        inverse: Array,
    ) -> Array:
        r"""Complete the velocity rows for vectors held in reference axes.

        With S the rotation of the turned vectors, the frame's velocity obeys
        :math:`\dot\nu_f = S c`, where c is the acceleration, for a turned v_b plus
        :math:`\omega \times v`. A turn :math:`\delta\theta` of the base under a vector s held in
        reference axes changes its base components by :math:`[s]_\times \delta\theta`.

        Returns c (6 + n,), in base axes like the rows that are set.
        """
        nv, groups = len(nu), self._map.groups
        lower = A[-nv:]
        turned_angular, turned_linear = self._map.axes
        c = acceleration.copy()
        if turned_linear:
            w, v = nu[ANGULAR], nu[LINEAR]
            c[LINEAR] += np.cross(w, v)
            lower[LINEAR, groups.omega_b] -= skew(v)
            lower[LINEAR, groups.v_b] += skew(w)
        turn = np.zeros((nv, 3))
        for turned, rows, columns in (
            (turned_angular, ANGULAR, groups.omega_b),
            (turned_linear, LINEAR, groups.v_b),
        ):
            if turned:
                turn += lower[:, columns] @ skew(nu[rows]) + inverse[:, rows] @ skew(force[rows])
                turn[rows] -= skew(c[rows])
        lower[:, groups.q_b] = turn @ chart.J
        return c

    def _set_kinematics(self, A: Array, chart: Chart, nu: Array) -> None:
        """Set the rows of q_b, r_b and q_m; `nu` (6 + n,) in base axes."""
        g, (turned_angular, turned_linear) = self._map.groups, self._map.axes
        w, Q, J, R = nu[ANGULAR], chart.Q, chart.J, chart.R
        A[g.q_b, g.q_b] = -0.5 * (np.outer(w, chart.q_b) / chart.q0 + skew(w))
        A[g.q_b, g.omega_b] = 0.5 * Q
        if turned_angular:
            A[g.q_b, g.q_b] += 0.5 * Q @ skew(w) @ J
            A[g.q_b, g.omega_b] = 0.5 * Q @ R.T
        if turned_linear:
            A[g.r_b, g.v_b] = np.eye(3)
        else:
            A[g.r_b, g.v_b] = R
            A[g.r_b, g.q_b] = -R @ skew(nu[LINEAR]) @ J
        A[g.q_m, g.qdot_m] = np.eye(self.robot.n)

    @staticmethod
    def _kinematic_rate(chart: Chart, nu: Array) -> Array:
        """Return d(q_b, r_b, q_m)/dt (6 + n,)."""
        return np.concatenate((0.5 * chart.Q @ nu[ANGULAR], chart.R @ nu[LINEAR], nu[6:]))

    def _reference_of(self, q: Array) -> Array:
        if not self._own_reference:
            return self._common["_reference"]
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
            "_reference": _frozen(pin.SE3ToXYZQUAT(state.reference)),
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


def _singular(robot: Robot, M: Array) -> SingularInertiaError:
    names = ["the base"] * 6 + ["?"] * robot.n
    for joint in robot.joints:
        names[joint.idx_v] = f"joint '{joint.name}'"
    diagonal = M.diagonal()
    massless = sorted({names[i] for i in np.flatnonzero(~(diagonal > 0.0))})
    if massless:
        return SingularInertiaError(
            f"{_enumerate(massless)} of '{robot.name}' moves no mass, so M cannot be inverted; "
            "give the links beyond it an inertia, or lock it"
        )
    scale = 1.0 / np.sqrt(diagonal)
    mode = np.linalg.eigh(scale[:, None] * M * scale)[1][:, 0]
    involved = [names[i] for i in np.argsort(-np.abs(mode)) if abs(mode[i]) > 0.1]
    return SingularInertiaError(
        f"M of '{robot.name}' is singular at this configuration: "
        f"{_enumerate(list(dict.fromkeys(involved)))} move no mass against each other; "
        "choose another configuration, give the links an inertia, or lock one of them"
    )


def _enumerate(names: list[str]) -> str:
    shown = names[:6]
    return ", ".join(shown) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
