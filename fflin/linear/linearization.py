"""Linear models: A, B, C and D about any point."""

from __future__ import annotations

from functools import partial
from math import hypot
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.rotation import skew
from fflin.base.validation import Array, truth, vector
from fflin.base.version import __version__
from fflin.dynamics.actuation import Actuation
from fflin.dynamics.chart import Chart
from fflin.dynamics.rnea import Accelerations, Rates
from fflin.dynamics.state import ANGULAR, LINEAR, Frame, StateMap, unknown_frame
from fflin.linear.certificate import certify, inertia_matrix
from fflin.linear.ignorable import ignorable_states
from fflin.linear.model import LinearModel
from fflin.linear.output_equations import output_equations
from fflin.linear.state_equations import STANDING, Point, at_rest, ride_along, state_equations
from fflin.robot.frames import ROOT
from fflin.robot.massless import require_inertia
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.dynamics.outputs import Sensing

# Sum of squares beyond which a matrix counts as not finite: its eigenvalues would not be. Up to
# velocities and inputs of the other size nothing overflows on the way to it.
LARGEST, _MODERATE = 1e200, 1e50


class Linearizer:
    r"""Linearise one robot many times; what does not change is prepared once.

    Threads may share one, taking turns; copied or pickled, it has a work space of its own.

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
    frame : {"hybrid", "local", "world"}, optional
        Axes of the base's velocities and wrenches, see `StateMap`; "hybrid" by default.
    reference : pin.SE3, optional
        Placement that attitude and position are relative to; by default the base's own at each
        point, so that the model is taken about the pose where the robot stands.
    moving : bool
        The error dynamics about a reference that moves through the point with the robot's own
        dynamics: the error is q_b = vec(q*^-1 q), r_b = R*^T (p - p*), the frame is "local", and
        f0 is zero. For a trajectory, and for relative equilibria such as a steady spin.

    Raises
    ------
    InputError
        If the frame is unknown, the reference is not a pin.SE3, or `moving` is asked for with a
        reference or with a frame other than "local".
    SingularInertiaError
        If M is singular at every configuration.
    ModelError
        If Pinocchio's Data for the robot would pass 1 GiB, or its model was changed after the
        robot was made.

    References
    ----------
    Y. Yang, J. Aerospace Engineering 25(3), 2012. J. Carpentier and N. Mansard, Analytical
    derivatives of rigid body dynamics algorithms, Robotics: Science and Systems, 2018.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        frame: Frame | None = None,
        reference: pin.SE3 | None = None,
        moving: bool = False,
    ) -> None:
        self.robot = robot
        moving = truth("moving", moving)
        if frame is None:
            frame = "local" if moving else "hybrid"
        elif not isinstance(frame, str):  # nor one whose comparison below is an array
            raise unknown_frame(frame)
        if moving and (reference is not None or frame != "local"):
            raise InputError(
                "moving=True takes the error in the moving base's own axes: leave out the "
                "reference, and the frame or make it 'local'"
            )
        self._moving = moving
        self._map = StateMap(robot, reference=reference, frame=frame)
        self._own_reference = reference is None
        require_inertia(robot)
        self._data = robot.create_data()
        self._lock = Lock()  # of the work space
        self._actuation = Actuation(self._map)
        self._accelerations = Accelerations(self._map, self._actuation, self._data)
        self._sensing: Sensing | None = None
        if robot.outputs != (FullState(),):
            from fflin.dynamics.outputs import Sensing

            self._sensing = Sensing(
                self._map,
                robot.outputs,
                gravity=np.array(robot.gravity),
                own_reference=self._own_reference,
            )
        # Where nothing acts at rest but u, A and all of B but M^-1 are known beforehand.
        self._free = (
            self._sensing is None
            and not self._moving
            and not any(robot.gravity)
            and not robot.stored_momentum
            and not any(values.any() for values in robot.passive)
        )
        self._plain = self._free and self._actuation.default
        given = hypot(*robot.gravity, *np.concatenate(robot.passive).tolist())
        self._moderate = given < _MODERATE
        nv, nx = 6 + robot.n, self._map.nx
        self._zero_v, self._zero_u, self._zero_x = (
            _frozen(np.zeros(size)) for size in (robot.nv, len(self._actuation.names), nx)
        )
        self._A_rest = _frozen(at_rest(self._map))
        self._nu = len(self._actuation.names)
        self._shape_B, self._lower = (nx, self._nu), slice(nv, nx)
        self._rooted = robot.model.jointPlacements[ROOT].isIdentity(0.0)
        self._reference = _frozen(pin.SE3ToXYZQUAT(self._map.reference))
        self._common = self._common_fields()
        self._at_rest_fields = self._common | {
            "A": self._A_rest,
            "f0": self._zero_x,
            "u0": self._zero_u,
            "v": self._zero_v,
            "_when_asked": {
                "x0": partial(_state_at_rest, self._map),
                "y0": partial(_state_at_rest, self._map),
                "_reference": partial(_own_reference, robot),
            },
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
        u : array_like (nu,), optional
            Over the robot's inputs, those on the base in the frame's axes; zero by default.

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
        if v is None and u is None and self._own_reference and self._plain:
            with self._lock:
                return self._at_rest(q)
        if v is not None:
            v = _frozen(robot.checked_velocity(v).copy())
        if u is not None:
            u = _frozen(vector("u", u, self._nu, "the robot's inputs").copy())
        v = self._zero_v if v is None else v
        u = self._zero_u if u is None else u
        with self._lock:
            if self._moderate and hypot(*v.tolist(), *u.tolist()) < _MODERATE:
                return self._anywhere(q, v, u)
            # What overflows is refused, and not warned of. Every call of NumPy costs more here.
            with np.errstate(over="ignore", invalid="ignore"):
                return self._anywhere(q, v, u)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy, in this process or another, needs a work space of its own.
        reference = None if self._own_reference else self._map.reference
        return _rebuilt, (self.robot, self._map.frame, reference, self._moving)

    def _at_rest(self, q: Array) -> LinearModel:
        B = np.zeros(self._shape_B)
        self._accelerations.invert(q, B[self._lower])
        B.setflags(write=False)
        return LinearModel._from_fields(self._at_rest_fields | {"B": B, "q": q})

    def _anywhere(self, q: Array, v: Array, u: Array) -> LinearModel:
        state, groups = self._map, self._map.groups
        chart = STANDING if self._own_reference else state.chart(q)
        nu, q_m = state.velocities(v), state.joint_positions(q)
        u_base = u if chart is STANDING else self._actuation.in_base_axes(chart, u)
        rates = self._accelerations.rates(q, v, nu, q_m, u_base)
        A, B = self._A_rest.copy(), np.zeros(self._shape_B)
        A[self._lower, groups.q_m] = rates.by_q_m
        A[self._lower, self._lower] = rates.by_nu
        B[self._lower] = rates.by_u
        point = Point(nu, u_base, rates.c, rates.gravity)
        f0 = state_equations(state, self._actuation, chart, point, A, B[self._lower])
        x0: Array = np.zeros(state.nx)
        if chart is STANDING:
            x0[groups.q_m] = q_m
            x0[self._lower] = nu
        else:
            x0 = state.to_state(q, v)
        drift = ride_along(state, point, A, f0) if self._moving else None
        C, D, y0 = self._seen(chart, rates, q, v, u_base, x0)
        for array in (A, B, f0) if self._sensing is None else (A, B, f0, C, D, y0):
            flat = array.ravel()
            if not flat.dot(flat) < LARGEST:  # nor NaN
                raise InputError("q, v or u is so large that the model is not finite")
            array.setflags(write=False)
        x0.setflags(write=False)
        fields = {"A": A, "B": B, "C": C, "D": D, "f0": f0}
        fields |= {"x0": x0, "y0": y0, "u0": u, "q": q, "v": v}
        fields["_reference"] = self._reference_of(q)
        if drift is not None:
            fields["_drift"] = _frozen(drift)
        return LinearModel._from_fields(self._common | fields)

    def _seen(
        self, chart: Chart, rates: Rates, q: Array, v: Array, u: Array, x0: Array
    ) -> tuple[Array, Array, Array]:
        """Return C, D and y0; `u` (nu,) in base axes."""
        sensing, state = self._sensing, self._map
        if sensing is None:
            return self._common["C"], self._common["D"], x0
        nu = state.velocities(v)
        a = rates.c.copy()
        if sensing.needs_acceleration:
            a[LINEAR] += rates.gravity - skew(nu[ANGULAR]).dot(nu[LINEAR])
        sensed = sensing.evaluate(self._data, q, v, state.spread(a))
        C, D = output_equations(state, self._actuation, chart, sensed, rates, nu, u)
        for row, index in sensing.states:
            C[row, index] = 1.0
            sensed.y[row] = x0[index]
        return C, D, sensed.y

    def _reference_of(self, q: Array) -> Array:
        if not self._own_reference:
            return self._reference
        return q[:7] if self._rooted else _own_reference(self.robot, q)

    def _common_fields(self) -> dict[str, Any]:
        robot, state = self.robot, self._map
        names, units = self._actuation.names, self._actuation.units
        seen = self._sensing or state
        return {
            "C": _frozen(np.eye(state.nx)),
            "D": _frozen(np.zeros((state.nx, len(names)))),
            "dt": 0.0,
            "state_names": state.names,
            "input_names": names,
            "output_names": seen.names,
            "state_units": state.units,
            "input_units": units,
            "output_units": seen.units,
            "frame": state.frame,
            "moving": self._moving,
            "robot": robot.name,
            "urdf_sha256": robot.urdf_sha256,
            "locked": robot.locked,
            "fflin_version": __version__,
            "pinocchio_version": pin.__version__,
            "_inertia": partial(inertia_matrix, robot),
            "_certify": partial(certify, robot),
            "_ignorable": partial(ignorable_states, robot),
        }


def linearize(
    robot: Robot,
    q: Array | None = None,
    v: Array | None = None,
    u: Array | None = None,
    *,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    moving: bool = False,
) -> LinearModel:
    """Linearise a robot about a point; at rest with neutral joints by default.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration in Pinocchio's order, see `configuration`; neutral by default.
    v : array_like (nv,), optional
        Velocity in Pinocchio's order; at rest by default.
    u : array_like (nu,), optional
        Over the robot's inputs, those on the base in the frame's axes; zero by default.
    frame : {"hybrid", "local", "world"}, optional
        Axes of the base's velocities and wrenches, see `StateMap`; "hybrid" by default.
    reference : pin.SE3, optional
        Placement that attitude and position are relative to; the base's own by default.
    moving : bool
        The error dynamics about a reference that moves through the point, see `Linearizer`.

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
    return Linearizer(robot, frame=frame, reference=reference, moving=moving)(q, v, u)


def _rebuilt(robot: Robot, frame: Frame, reference: pin.SE3 | None, moving: bool) -> Linearizer:
    return Linearizer(robot, frame=frame, reference=reference, moving=moving)


def _state_at_rest(state: StateMap, q: Array) -> Array:
    x0: Array = np.zeros(state.nx)
    x0[state.groups.q_m] = state.joint_positions(q)
    return _frozen(x0)


def _own_reference(robot: Robot, q: Array) -> Array:
    root = robot.model.jointPlacements[ROOT]
    if root.isIdentity(0.0):
        return q[:7]
    return _frozen(pin.SE3ToXYZQUAT(root * pin.XYZQUATToSE3(q[:7])))


def _frozen(array: Array) -> Array:
    array.setflags(write=False)
    return array
