"""Linearisation about any point: computation of A, B, C and D."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import pairwise
from threading import Lock
from typing import Any

import numpy as np
import pinocchio as pin

from fflin.base import __version__
from fflin.base.errors import ConstraintError, InputError, listed, located
from fflin.base.validation import Array, frozen, number, truth, vector
from fflin.dynamics.closure import Closure
from fflin.dynamics.coordinates import Chart, Frame, ReferenceChart
from fflin.dynamics.outputs import Sensing
from fflin.dynamics.rnea import AccelerationDerivatives, Accelerations, Turning
from fflin.dynamics.state import Actuation, StateMap
from fflin.linear.aba_route import inertia_matrix
from fflin.linear.check import certify
from fflin.linear.constrained import (
    Motions,
    Reducer,
    Reduction,
    independent_states,
    reduced_fields,
)
from fflin.linear.constrained_rest import RestSolver
from fflin.linear.files import given
from fflin.linear.model import LinearModel
from fflin.linear.state_equations import assemble, drift, output_equations
from fflin.robot.fields import magnitudes_of
from fflin.robot.joints import ROOT
from fflin.robot.outputs import FullState
from fflin.robot.robot import Robot

# The sum of the squared entries of each array of a model must be below this value. For larger
# values, the computation of eigenvalues would overflow.
LARGEST = 1e200

_REFERENCE_CHART: Chart = ReferenceChart()


class Prepared:
    """Data of a robot that do not depend on the operating point; arrays are read-only.

    The arguments and errors are documented in `Linearizer`.

    Attributes
    ----------
    robot : Robot
    map : StateMap
    actuation : Actuation
    sensing : Sensing or None
        None if the outputs are the state.
    moving : bool
    own_reference : bool
        Whether the reference is the base placement at each point.
    unforced : bool
        Whether no forces act on the robot at rest, and the outputs are the state.
    free : bool
        Whether `common` and `rest` contain all matrices except B, if the robot is at rest and the
        base is at the reference.
    common : dict
        Fields of a model that are the same at all points.
    rest : dict
        A, f0, u0 and v of a model at rest without forces, with the base at the reference.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        frame: Frame | None,
        reference: pin.SE3 | None,
        moving: bool,
    ) -> None:
        self.robot = robot
        self.moving = truth("moving", moving)
        if moving and frame is None:
            frame = "local"
        self.map = state = StateMap(robot, reference=reference, frame=frame)
        if moving and (reference is not None or state.frame != "local"):
            raise InputError(
                "moving=True measures the error in the axes of the moving base, so no reference "
                "and no frame other than 'local' can be given; leave out reference and frame"
            )
        # If no reference is given, the reference is the base placement at the operating point. In
        # orbit, it is the orbital frame instead, unless the reference moves.
        self.own_reference = reference is None and (moving or robot.orbit is None)
        robot.require_inertia()
        self.actuation = Actuation(state)
        self.sensing: Sensing | None = None
        if robot.outputs != (FullState(),):
            self.sensing = Sensing(
                state, robot.outputs, own_reference=self.own_reference
            )
        has_other_forces = (
            robot.orbit
            or any(robot.gravity)
            or robot.stored_momentum
            or np.any(robot.springs)
        )
        self.unforced = self.sensing is None and not moving and not has_other_forces
        # In this case, all matrices of a model at rest except B are known in advance.
        self.free = self.unforced and not robot.constraints
        nx = state.nx
        nv = state.nx // 2
        nu = len(self.actuation.names)
        outputs = self.sensing or state
        self.common: dict[str, Any] = {
            "state_names": state.names,
            "state_units": state.units,
            "input_names": self.actuation.names,
            "input_units": self.actuation.units,
            "output_names": outputs.names,
            "output_units": outputs.units,
            "C": frozen(np.eye(nx)),
            "D": frozen(np.zeros((nx, nu))),
            "dt": 0.0,
            "frame": state.frame,
            "moving": self.moving,
            "robot": robot.name,
            "urdf_sha256": robot.urdf_sha256,
            "locked": robot.locked,
            "fflin_version": __version__,
            "pinocchio_version": pin.__version__,
            "_inertia": partial(inertia_matrix, robot),
            "_certify": partial(certify, robot),
            "_ignorable": partial(ignorable_states, robot),
            "_wheels": partial(wheels_of, robot),
            "_limits": partial(magnitudes_of, robot),
            "weights": robot.weights,
            "mean_motion": robot.orbit.mean_motion if robot.orbit else 0.0,
            "_robot": robot,
        }
        if not self.own_reference:
            self.common["placement"] = frozen(pin.SE3ToXYZQUAT(state.reference))
        A = np.zeros((nx, nx))
        # At rest, N of (2.1) is 1/2 for the attitude chart, and 1 for the other coordinates.
        N = np.diag([0.5] * 3 + [1.0] * (nv - 3))
        A[:nv, nv:] = N
        self.rest: dict[str, Array] = {
            "A": frozen(A),
            "f0": frozen(np.zeros(nx)),
            "u0": frozen(np.zeros(nu)),
            "v": frozen(np.zeros(robot.nv)),
        }

    def state_at(self, lin: LinearModel) -> Array:
        """Return the state (nx,) at the point of a model."""
        state, q = self.map, lin.q
        chart: Chart = _REFERENCE_CHART
        r_b = chart.q_b
        if not self.own_reference:
            chart = state.chart(q)
            r_b = state.positions(q)
        return frozen(
            state.compose(chart, r_b, state.joint_positions(q), state.velocities(lin.v))
        )


def own_reference(robot: Robot, lin: LinearModel) -> Array:
    """Return the default reference: the base placement (7,) at the point of a model."""
    root, q = robot.model.jointPlacements[ROOT], lin.q[:7]
    if root.isIdentity(0.0):
        return q
    return frozen(pin.SE3ToXYZQUAT(root * pin.XYZQUATToSE3(q)))


def ignorable_states(robot: Robot, lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the ignorable coordinates of a linear model of this robot."""
    # The dynamics do not depend on ignorable coordinates. In orbit, the dynamics depend on the
    # position and the attitude of the base. For other robots, the position is ignorable, because
    # gravity is zero or uniform. If gravity is zero, the attitude relative to a moving reference
    # (`lin.moving`) is also ignorable.
    groups = list[str]()
    if lin.moving and not any(robot.gravity):
        groups.append("q_b")
    groups.append("r_b")
    if robot.orbit:
        groups = []
    if robot.anchored:
        groups = []
    base = [f"{group}.{axis}" for group in groups for axis in "xyz"]
    return (*base, *(f"q_m.{name}" for name in robot.rotors))


def wheels_of(robot: Robot, lin: LinearModel) -> tuple[str, ...]:
    """Return the names of the joints that are flown as wheels in a linear model of this robot."""
    return robot.flown_wheels(lin)


class Linearizer:
    r"""Linearise one robot about many operating points; common data are computed only once.

    Threads may share a `Linearizer`, but only one thread computes at a time. To compute in
    parallel, copy or pickle the `Linearizer`: every copy has a separate work space.

    About a point at rest, the matrices of the linear model are

    .. math::
        A = \begin{bmatrix} 0 & N \\ 0 & 0 \end{bmatrix}, \qquad
        B = \begin{bmatrix} 0 \\ M^{-1} \end{bmatrix}.

    M is the joint-space inertia in state order, and N = blkdiag(E3/2, E3, En) with identity
    matrices E3 and En of sizes 3 and n.

    About other points, the acceleration :math:`\dot\nu = M^{-1}(\tau - b(q, \nu))` is
    differentiated in base axes as :math:`-M^{-1}\,\partial\,\mathrm{rnea}(q, \nu, \dot\nu)`, where
    rnea is the inverse dynamics. The derivatives are then transformed to the attitude chart and to
    the axes of `frame`. The position
    and linear velocity of the base do not affect the dynamics (Galilean invariance). Therefore they
    are set to zero in the computation, so that a large distance from the origin does not reduce the
    accuracy. docs/derivation.md derives the equations; its section 14 treats robots in orbit, whose
    velocities are relative to the orbital frame.

    Parameters
    ----------
    robot : Robot
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
        Axes of the base velocities and wrenches, see `StateMap`. The default is "hybrid". For a
        robot in orbit, the frames are "lvlh" (default) and "hill".
    reference : pin.SE3, optional
        Placement relative to which the attitude and position of the base are measured. The default
        is the base placement at each operating point, so that q_b and r_b are zero there. For a
        robot in orbit, the default is the orbital frame.
    moving : bool
        Whether to return the error dynamics about a moving reference, which passes through the
        operating point and obeys the dynamics of the robot. The frame is then "local", and f0 is
        zero. With the attitude q (rotation matrix R) and the position p of the base, the errors are
        :math:`q_b = \mathrm{vec}(q^{*-1} q)` and :math:`r_b = R^{*T} (p - p^*)`; a star denotes the
        reference. Use a moving reference for trajectories, and for relative equilibria such as a
        steady spin.
    independent : sequence of str, optional
        Names or patterns of the coordinates of the models of a robot with constraints, such as
        joint names, "q_b" or "r_b.x". By default, the coordinates are chosen at the first point, by
        a factorisation with pivoting in units of equal kinetic energy. All models of a
        `Linearizer` have the same coordinates.

    Raises
    ------
    InputError
        If one of these conditions is true:

        - the frame is unknown, or the reference is not a pin.SE3;
        - `moving` is given with a reference, or with a frame other than "local".
    SingularInertiaError
        If the inertia M is singular at every configuration.
    ModelError
        If Pinocchio's Data for the robot would exceed 1 GiB, or the robot's Pinocchio model
        (``robot.model``) was modified after the robot was created.

    Attributes
    ----------
    robot : Robot
        The robot that is linearised.
    prepared : Prepared
        Prepared data, which are the same for all operating points.

    References
    ----------
    Y. Yang, J. Aerospace Engineering 25(3), 2012. J. Carpentier and N. Mansard, Analytical
    derivatives of rigid body dynamics algorithms, Robotics: Science and Systems, 2018.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> linearizer = fflin.Linearizer(robot, frame="local")
    >>> models = [linearizer(fflin.configuration(robot, {"joint_2": x})) for x in (0.0, 0.4)]
    >>> len(models), models[1].frame
    (2, 'local')
    """

    def __init__(
        self,
        robot: Robot,
        *,
        frame: Frame | None = None,
        reference: pin.SE3 | None = None,
        moving: bool = False,
        independent: Sequence[str] | None = None,
    ) -> None:
        self.prepared = ready = Prepared(
            robot, frame=frame, reference=reference, moving=moving
        )
        self.robot = robot
        self._closure: Closure | None = None
        self._reducer: Reducer | None = None
        self._rest: RestSolver | None = None
        if robot.constraints:
            self._closure = Closure(ready.map)
            self._reducer = Reducer(self._closure, independent, moving=moving)
            if ready.unforced and ready.own_reference and not ready.actuation.torquers:
                self._rest = RestSolver(
                    self._closure, ready.actuation, robot.create_data()
                )
        elif independent is not None:
            raise InputError(
                f"independent is given, but '{robot.name}' has no constraints, so that all "
                "coordinates are independent; leave out independent"
            )
        self._data = robot.create_data()
        self._lock = Lock()  # protects the work space
        self._accelerations = Accelerations(
            ready.map, ready.actuation, self._data, self._closure
        )
        nv = ready.map.nx // 2
        nx = ready.map.nx
        self._shape_B = (nx, len(ready.actuation.names))
        self._lower = slice(nv, nx)
        self._rate = "drift" if ready.moving else "f0"
        # Fields of a model at rest, except B and q. The fields in `slow` are computed at the first
        # use, because they are expensive.
        slow = {"x0": ready.state_at, "y0": ready.state_at}
        self._fields = {**ready.common, **ready.rest, "_computed": slow}
        if ready.own_reference:
            slow["placement"] = partial(own_reference, robot)
        # Default velocity and default inputs: all zero.
        self._still = np.zeros(robot.nv), np.zeros(self._shape_B[1])
        # Whether B of a model at rest is [0; M^-1], and all other matrices are known. Inputs,
        # outputs and reference must be the default ones, and `moving` must be false. The robot must
        # have no springs, dampers, gravity, orbit or stored momentum.
        self._known = ready.free and ready.own_reference and ready.actuation.default

    def __call__(
        self,
        q: Array | None = None,
        v: Array | None = None,
        u: Array | None = None,
        *,
        t: float = 0.0,
    ) -> LinearModel:
        """Linearise about a point; see `linearize` for the arguments and errors."""
        robot = self.robot
        # The default time needs no check, which would take long compared with a model at rest.
        if t.__class__ is not float or t != 0.0:
            t = number("t", t)
        q = robot.neutral() if q is None else robot.checked_configuration(q).copy()
        at_rest = v is None and u is None
        still_v, still_u = self._still
        v = still_v if v is None else robot.checked_velocity(v).copy()
        u = (
            still_u
            if u is None
            else vector("u", u, len(still_u), "the robot's inputs").copy()
        )
        with self._lock:
            if at_rest and self._known:
                B = np.zeros(self._shape_B)
                self._accelerations.inertia.invert(q, B[self._lower], quick=True)
                B.setflags(write=False)
                q.setflags(write=False)
                return LinearModel(self._fields, B=B, q=q)
            _require_no_moment(self.prepared.actuation, u)
            if at_rest and self._rest is not None:
                resting = self._rest.model(q)
                if resting is not None:
                    return resting
            if self._closure is not None:
                q = self._closure.configuration(q)
                v = self._closure.velocity(q, v)
            # Suppress NumPy's overflow warnings, because `_require_finite` reports an overflow.
            with np.errstate(over="ignore", invalid="ignore"):
                return self._anywhere(q, v, u, t)

    @property
    def constrained(self) -> bool:
        """Whether the robot has constraints."""
        return self._closure is not None

    @property
    def independent(self) -> tuple[str, ...]:
        """Independent coordinates of a robot with constraints, once they are chosen."""
        if self._reducer is None:
            return ()
        return self._reducer.independent or ()

    @property
    def constrained_names(self) -> dict[str, tuple[str, ...]]:
        """Names and units of the states of a robot with constraints; empty without constraints."""
        if self._reducer is None:
            return {}
        return self._reducer.names

    def write_by_u(self, q: Array, out: Array) -> None:
        """Write the lower half of B (6 + n, nu) about a valid q at rest; see `Prepared.free`."""
        inertia = self._accelerations.inertia
        actuation = self.prepared.actuation
        nv = len(out)
        with self._lock:
            inverse = out if actuation.default else np.empty((nv, nv))
            inertia.invert(q, inverse)
            if not actuation.default:
                # Place the base in its neutral pose at the origin to avoid rounding errors. The
                # result is the same, because B_u in base axes does not depend on the base pose.
                np.matmul(
                    inverse, actuation.columns(self._data, inertia.centred(q)), out=out
                )

    def __reduce__(self) -> tuple[partial[Linearizer], tuple[Robot]]:
        # The work space cannot be shared, so copies and pickles are built by the constructor.
        state, moving = self.prepared.map, self.prepared.moving
        reference = None if self.prepared.own_reference else state.reference
        make = partial(
            type(self), frame=state.frame, reference=reference, moving=moving
        )
        if self._reducer is not None:
            make = partial(make, independent=self._reducer.independent)
        return make, (self.robot,)

    def _anywhere(self, q: Array, v: Array, u: Array, t: float) -> LinearModel:
        ready = self.prepared
        state = ready.map
        chart, made = self._in_all_states(q, v, u, t)
        time = {"t": t} if state.varying else {}
        contact = self._accelerations.contact
        if self._reducer is not None and contact is not None:
            reduction = self._reducer.reduction(chart, q, state.velocities(v), contact)
            names = self._reducer.names
            if self._rest is not None and self._rest.waits:
                self._rest.choose(reduction.kept, q, self._fields | names)
            slow = dict(self._fields["_computed"])
            slow["x0"] = partial(independent_states, slow["x0"], reduction.kept)
            fields = {
                **self._fields,
                **made,
                **names,
                **reduced_fields(reduction, ready.rest | made, made.get("C")),
                "_computed": slow,
                "_inertia": partial(given, frozen(reduction.M)),
            }
            return LinearModel(fields, **time)
        if state.varying:
            return LinearModel(self._fields | made, t=t)
        return LinearModel(self._fields | made)

    def _in_all_states(
        self, q: Array, v: Array, u: Array, t: float
    ) -> tuple[Chart, dict[str, Array]]:
        """Return the chart at a point, and the arrays of the model in all states of the robot."""
        ready, lower = self.prepared, self._lower
        state, actuation = ready.map, ready.actuation
        state.move_to(t)
        chart = _REFERENCE_CHART if ready.own_reference else state.chart(q)
        nu = state.velocities(v)
        u_base = actuation.in_base_axes(chart, u)
        A, B = ready.rest["A"].copy(), np.zeros(self._shape_B)
        rates = self._accelerations.rates(q, v, nu, u_base, A[lower], B[lower])
        seen: dict[str, Array] = {}
        if ready.sensing is not None:
            r_b = chart.q_b
            if not ready.own_reference:
                r_b = state.positions(q)
            x0 = state.compose(chart, r_b, state.joint_positions(q), nu)
            point = q, v, nu, u_base
            seen = output_equations(
                ready.sensing,
                actuation,
                self._data,
                chart,
                rates,
                x0,
                point,
                self._accelerations.contact,
            )
            _require_finite(*seen.values())
        rate = assemble(
            actuation,
            chart,
            nu,
            u_base,
            rates,
            A,
            moving=ready.moving,
            turning=self._accelerations.turning,
        )
        _require_finite(A, B, rate)
        if ready.moving:
            rate = drift(state, rate, rates.gravity)
        made = {"A": A, "B": B, "q": q, "v": v, "u0": u, self._rate: rate} | seen
        for array in made.values():
            array.setflags(write=False)
        return chart, made

    def tangent_along(self, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        """Return A (N, nx, nx) and B (N, nx, nu) in all nx states, about N closed points.

        A maps errors on the manifold of the constraints to their rates.
        """
        A = np.empty((len(q), *self.prepared.rest["A"].shape))
        B = np.empty((len(q), *self._shape_B))
        with self._lock:
            for k, point in enumerate(zip(q, v, u, strict=True)):
                _, made = self._in_all_states(*point, 0.0)
                A[k], B[k] = made["A"], made["B"]
        return A, B

    def motions(self, q: Array, v: Array) -> Motions:
        """Return the motions that the constraints permit at a closed point."""
        assert self._closure is not None
        with self._lock:
            return Motions.at(self._closure, q, v)

    def reduction(
        self, q: Array, v: Array, independent: Sequence[str] | None = None
    ) -> Reduction:
        """Return the reduction to named coordinates at a closed point, by default the best ones."""
        motions = self.motions(q, v)
        if independent is None:
            return motions.reduction(motions.best())
        names = self.prepared.map.names
        picked = np.array([names.index(name) for name in independent])
        return motions.reduction(picked)

    def along(
        self, q: Array, v: Array, u: Array, t: Array | None = None
    ) -> dict[str, Array]:
        """Return A, B, C, D and y (N, ..) about N valid points, with the inputs u in base axes.

        Each model must be relative to the base placement at its point. t (N,) are the times [s],
        which matter only in an elliptic orbit, and for magnetorquers.
        """
        for inputs in u:
            _require_no_moment(self.prepared.actuation, inputs)
        ready = self.prepared
        lower = self._lower
        count = len(q)
        times = np.zeros(count) if t is None else t
        if self._closure is not None:
            return self._along_constrained(q, v, u, times)
        state, actuation, sensing = ready.map, ready.actuation, ready.sensing
        chart, nu = ReferenceChart(count), state.velocities(v)
        x0 = state.compose(chart, chart.q_b, state.joint_positions(q), nu)
        A = np.tile(ready.rest["A"], (count, 1, 1))
        B = np.zeros((count, *self._shape_B))
        c = np.empty_like(nu)
        gravity = np.empty((count, 3))
        seen = []
        turnings = list[Turning]()
        with self._lock:
            for k, point in enumerate(zip(q, v, nu, u, strict=True)):
                state.move_to(float(times[k]))
                rates = self._accelerations.rates(*point, A[k, lower], B[k, lower])
                c[k], gravity[k] = rates.c, rates.gravity
                if self._accelerations.turning is not None:
                    turnings.append(self._accelerations.turning)
                if sensing is not None:
                    measured_point = _REFERENCE_CHART, rates, x0[k], point
                    seen.append(
                        output_equations(
                            sensing, actuation, self._data, *measured_point
                        )
                    )
        turning = None
        if turnings:
            turning = Turning(*map(np.array, zip(*turnings, strict=True)))
        all_rates = AccelerationDerivatives(c, A[:, lower], B[:, lower], gravity)
        f0 = assemble(
            actuation,
            chart,
            nu,
            u,
            all_rates,
            A,
            moving=ready.moving,
            turning=turning,
        )
        if sensing is None:
            C, D = (np.tile(ready.common[key], (count, 1, 1)) for key in "CD")
            y = x0
        else:
            C, D, y = (
                np.array([equations[key] for equations in seen])
                for key in ("C", "D", "y0")
            )
        for arrays in zip(A, B, C, D, f0, y, strict=True):
            _require_finite(*arrays)
        return {"A": A, "B": B, "C": C, "D": D, "y": y}

    def on_constraints(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Return q and v on the constraints, at a point of an interpolated motion."""
        closure = self._closure
        if closure is None:
            return q, v
        closure.constraints.settle(q)
        q = closure.nearest(q)
        kept = closure.kept(closure.tangent(q), q, closure.state.velocities(v))
        return q, closure.state.spread(kept)

    def _along_constrained(
        self, q: Array, v: Array, u: Array, times: Array
    ) -> dict[str, Array]:
        """Return the arrays of `along` in the independent states, about the nearest points."""
        models = []
        for index, t in enumerate(times.tolist()):
            with located(f"at t = {t:g} s"), self._lock:
                point = self.on_constraints(q[index], v[index])
                with np.errstate(over="ignore", invalid="ignore"):
                    models.append(self._anywhere(*point, u[index], t))
        arrays = {key: np.array([getattr(x, key) for x in models]) for key in "ABCD"}
        maps = np.array([model._all_states for model in models])
        return {**arrays, "y": np.array([model.y0 for model in models]), "T": maps}

    def require_same_side(self, maps: Array, times: Array) -> None:
        """Raise `ConstraintError` if the independent coordinates stop between two close points.

        There, the basis of the velocities that belongs to the coordinates becomes infinite, and
        changes its orientation. `maps` (N, nx, 2 d) are the maps T of the points.
        """
        nv, d = maps.shape[1] // 2, maps.shape[2] // 2
        bases = maps[:, nv:, d:]
        for index, (before, after) in enumerate(pairwise(bases)):
            if np.linalg.slogdet(before.T @ after)[0] > 0.0:
                continue
            raise ConstraintError(
                f"the coordinates {listed(self.independent)} do not determine the motion between "
                f"t = {times[index]:g} s and {times[index + 1]:g} s; give other coordinates with "
                "independent=, or split the trajectory there"
            )


def _require_finite(*arrays: Array) -> None:
    """Raise `InputError` if an array contains NaN or has a squared norm of `LARGEST` or more."""
    for array in arrays:
        if not np.vdot(array, array) < LARGEST:  # true for NaN as well
            raise InputError(
                "the model is not finite, because q, v or u is too large; check their units"
            )


def linearize(
    robot: Robot,
    q: Array | None = None,
    v: Array | None = None,
    u: Array | None = None,
    *,
    frame: Frame | None = None,
    reference: pin.SE3 | None = None,
    moving: bool = False,
    independent: Sequence[str] | None = None,
    t: float = 0.0,
) -> LinearModel:
    """Linearise a robot about an operating point, by default at rest with neutral joints.

    Parameters
    ----------
    robot : Robot
    q : array_like (nq,), optional
        Configuration in Pinocchio's order, see `configuration`; neutral by default.
    v : array_like (nv,), optional
        Velocity in Pinocchio's order, see `velocity`; zero by default.
    u : array_like (nu,), optional
        Inputs of the robot, see `effort`; zero by default.
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
        Axes of the base's velocities and wrenches, see `StateMap`; by default
        "hybrid", or "lvlh" if the robot is in orbit.
    reference : pin.SE3, optional
        Pose relative to which the base is measured: by default the base pose at the
        operating point, or the orbital frame if the robot is in orbit.
    moving : bool
        Whether to return error dynamics about a moving reference; see `Linearizer`.
    independent : sequence of str, optional
        Coordinates of the model of a robot with constraints, see `Linearizer`.
    t : float
        Time [s] of the model, in an elliptic orbit or with magnetorquers.

    Returns
    -------
    LinearModel
        Model with the equations in `Linearizer`, which is faster for many points.

    Raises
    ------
    InputError
        If an argument has a wrong size or value.
    ConstraintError
        If q or v violates the constraints, or the rank of these changes near q.
    ChartError
        If the base is rotated by 180 deg from the reference.
    SingularInertiaError
        If the inertia matrix is singular because a joint moves no mass.
    ModelError
        If the robot is too large for the memory limit, see `Linearizer`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}))
    >>> lin.A.shape, lin.B.shape
    ((18, 18), (18, 9))
    """
    linearizer = Linearizer(
        robot, frame=frame, reference=reference, moving=moving, independent=independent
    )
    return linearizer(q, v, u, t=t)


def _require_no_moment(actuation: Actuation, u: Array) -> None:
    """Raise `InputError` if the moment of a magnetorquer is not zero."""
    for _, index, _ in actuation.torquers:
        if u[index]:
            raise InputError(
                f"the moment of {actuation.names[index]} is {u[index]:g} A m^2 at the operating "
                "point, expected 0; linear models do not contain the change of its torque with "
                "the attitude"
            )
