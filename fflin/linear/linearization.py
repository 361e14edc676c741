"""Linearisation: A, B, C and D about any point."""

from __future__ import annotations

from functools import partial
from math import hypot
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin

from fflin.base.errors import InputError
from fflin.base.validation import Array, vector
from fflin.dynamics.chart import Chart, Standing
from fflin.dynamics.rnea import Accelerations
from fflin.dynamics.state import Frame
from fflin.kernel.compiled import checked_engine
from fflin.linear.model import LinearModel
from fflin.linear.output_equations import output_equations
from fflin.linear.prepared import LARGEST, prepare
from fflin.linear.state_equations import assemble, drift
from fflin.robot.robot import Robot

if TYPE_CHECKING:
    from fflin.kernel.accelerations import RowOfOne

# With velocities and inputs below this nothing overflows on the way to `LARGEST`.
_MODERATE = 1e50


class Linearizer:
    r"""Linearisation of one robot at many points; data common to all points are prepared once.

    Threads may share a `Linearizer`, but only one thread computes at a time. Every copy, including
    a pickled one, has its own work space.

    At rest, with N = blkdiag(E3/2, E3, En) and the joint-space inertia M in state order,

    .. math::
        A = \begin{bmatrix} 0 & N \\ 0 & 0 \end{bmatrix}, \qquad
        B = \begin{bmatrix} 0 \\ M^{-1} \end{bmatrix}.

    At other points :math:`\dot\nu = M^{-1}(\tau - b(q, \nu))` is differentiated in base axes as
    :math:`-M^{-1}\,\partial\,\mathrm{rnea}(q, \nu, \dot\nu)`, then transformed to the chart and the
    velocity frame. The dynamics do not depend on the position and linear velocity of the base
    (Galilean invariance). The evaluation leaves out both, so no accuracy is lost if the base is far
    from the origin. docs/derivation.md has the equations. Section 14 covers a robot in orbit, whose
    rates are relative to the orbit's frame.

    Parameters
    ----------
    robot : Robot
    frame : {"hybrid", "local", "world", "lvlh", "hill"}, optional
        Axes of the base velocities and wrenches, see `StateMap`. The default is "hybrid". A robot
        in orbit needs "lvlh" (its default) or "hill".
    reference : pin.SE3, optional
        Placement that attitude and position are relative to. The default is the base placement at
        each point, so that q_b and r_b are zero there. For a robot in orbit, it is the orbit's
        frame.
    moving : bool
        Whether to return the error dynamics about a moving reference. This reference passes through
        the point and obeys the dynamics of the robot. The error is q_b = vec(q*^-1 q), r_b = R*^T
        (p - p*), the frame is "local", and f0 is zero. Use it for trajectories, and for relative
        equilibria such as a steady spin.
    engine : {"python", "compiled"}, optional
        Engine for the accelerations of points with velocity, springs or forces: Python by
        default, or the compiled kernel of sweeps. Both engines agree to machine precision.

    Raises
    ------
    InputError
        If one of these holds:

        - the frame is unknown, or the reference is not a pin.SE3;
        - `moving` is given with a reference, or with a frame other than "local";
        - the compiled engine is requested, but numba is not installed, or the engine does not
          support the robot.
    SingularInertiaError
        If M is singular at every configuration.
    ModelError
        If Pinocchio's Data for the robot would exceed 1 GiB, or its model was changed after the
        robot was made.
    UnknownNameError
        If there is no such engine.

    Attributes
    ----------
    robot : Robot
        The robot that is linearised.
    prepared : Prepared
        Data that are the same for all points.

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
        engine: str | None = None,
    ) -> None:
        self.prepared = ready = prepare(robot, frame=frame, reference=reference, moving=moving)
        self.robot, self._engine = robot, checked_engine(engine)
        self._data = robot.create_data()
        self._lock = Lock()  # of the work space
        self._accelerations = Accelerations(ready.map, ready.actuation, self._data)
        self._source: Accelerations | RowOfOne = self._accelerations
        if engine == "compiled":
            from fflin.kernel.accelerations import RowOfOne

            self._source = RowOfOne(ready.kernel(), self._accelerations)
        self._standing: Chart = Standing()
        nv, nx = ready.map.nx // 2, ready.map.nx
        self._shape_B, self._lower = (nx, len(ready.actuation.names)), slice(nv, nx)
        given = hypot(*robot.gravity, *np.concatenate(robot.springs).tolist())
        self._moderate = given < _MODERATE
        self._fields, self._rate = ready.fields, "_drift" if ready.moving else "f0"
        # What stands for rest and no input.
        self._still = np.zeros(robot.nv), np.zeros(self._shape_B[1])
        # Where nothing acts at rest but u, A and all of B but M^-1 are known beforehand.
        self._known = ready.free and ready.own_reference and ready.actuation.default

    def __call__(
        self, q: Array | None = None, v: Array | None = None, u: Array | None = None
    ) -> LinearModel:
        """Linearise about a point; arguments and errors are as in `linearize`."""
        robot = self.robot
        q = robot.neutral() if q is None else robot.checked_configuration(q).copy()
        known = v is None and u is None and self._known
        v = self._still[0] if v is None else robot.checked_velocity(v).copy()
        if u is None:
            u = self._still[1]
        else:
            u = vector("u", u, self._shape_B[1], "the robot's inputs").copy()
        with self._lock:
            if known:
                return self._at_rest(q)
            if self._moderate and hypot(*v.tolist(), *u.tolist()) < _MODERATE:
                return self._anywhere(q, v, u)
            # An overflow is refused below, so NumPy need not warn of it. Not always done, since
            # every call of NumPy costs more in here.
            with np.errstate(over="ignore", invalid="ignore"):
                return self._anywhere(q, v, u)

    def __reduce__(self) -> tuple[Any, ...]:
        # A copy, in this process or another, needs a work space of its own.
        ready = self.prepared
        reference = None if ready.own_reference else ready.map.reference
        options: dict[str, Any] = {
            "frame": ready.map.frame,
            "reference": reference,
            "moving": ready.moving,
        }
        return partial(type(self), **options, engine=self._engine), (self.robot,)

    def _at_rest(self, q: Array) -> LinearModel:
        B = np.zeros(self._shape_B)
        self._accelerations.invert(q, B[self._lower])
        B.setflags(write=False)
        q.setflags(write=False)
        return LinearModel.from_fields(self._fields | {"B": B, "q": q})

    def _anywhere(self, q: Array, v: Array, u: Array) -> LinearModel:
        ready = self.prepared
        state = ready.map
        chart, r_b = self._standing, self._standing.q_b
        if not ready.own_reference:
            chart, r_b = state.chart(q), state.positions(q)
        nu, q_m = state.velocities(v), state.joint_positions(q)
        u_base = ready.actuation.in_base_axes(chart, u)
        A, B = ready.fields["A"].copy(), np.zeros(self._shape_B)
        x0 = state.compose(chart, r_b, q_m, nu)
        made = {"A": A, "B": B, "x0": x0}
        rates = self._source.rates(q, v, nu, q_m, u_base, A[self._lower], B[self._lower])
        if ready.sensing is not None:
            made |= output_equations(ready, self._data, chart, rates, x0, (q, v, nu, u_base))
        rate = assemble(state, ready.actuation, chart, nu, u_base, rates, A, moving=ready.moving)
        for array in (rate, *made.values()):
            flat = array.ravel()
            if array is not x0 and not flat.dot(flat) < LARGEST:  # nor NaN
                raise InputError(
                    "the model is not finite, because q, v or u is too large; check their units"
                )
        rate = drift(state, rate, rates.gravity) if ready.moving else rate
        return self._model(q, v, u, rate, made)

    def _model(
        self, q: Array, v: Array, u: Array, rate: Array, made: dict[str, Array]
    ) -> LinearModel:
        """Put a model together, of arrays that nobody else has."""
        made["q"], made[self._rate] = q, rate
        if v is not self._still[0]:
            made["v"] = v
        if u is not self._still[1]:
            made["u0"] = u
        for array in made.values():
            array.setflags(write=False)
        made.setdefault("y0", made["x0"])
        return LinearModel.from_fields(self._fields | made)


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
    """Linearise a robot about a point, by default at rest with neutral joints.

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
        Pose that attitude and position are relative to; by default the base pose,
        or the orbit's frame if the robot is in orbit.
    moving : bool
        Return the error dynamics about a reference that moves through the point.

    Returns
    -------
    LinearModel
        See `Linearizer` for the equations, and to linearise at many points.

    Raises
    ------
    InputError
        If an argument has a wrong size or value.
    ChartError
        If the base is rotated by 180 deg from the reference.
    SingularInertiaError
        If a joint moves no mass.
    ModelError
        If the robot is too large.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}))
    >>> lin.A.shape, lin.B.shape
    ((18, 18), (18, 9))
    >>> lin.is_equilibrium(1e-9)
    True
    """
    return Linearizer(robot, frame=frame, reference=reference, moving=moving)(q, v, u)
