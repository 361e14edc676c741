"""The linear model: matrices, names, units, and the figures that prove it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fflin.base.errors import InputError, MissingPackageError
from fflin.base.frozen import FrozenArrays
from fflin.base.validation import Array, number
from fflin.linear.sampling import held_exponential

if TYPE_CHECKING:
    import pinocchio as pin

    from fflin import ToolModel
    from fflin.dynamics.state import Frame
    from fflin.robot.robot import Robot

_new, _set = object.__new__, object.__setattr__


@dataclass(frozen=True)
class Certificate:
    """The figures that prove a linear model; all are relative and of the order of round-off.

    Attributes
    ----------
    condition : float
        Condition number of M scaled to a unit diagonal; round-off times this is what to expect.
    inertia_residual : float
        Largest entry of ``M M^-1 - E``, scaled likewise.
    route_A, route_B : float
        Largest difference to A and B built from Pinocchio's ABA derivatives, relative to the
        block it stands in.
    f0 : float
        Largest entry of the state derivative at the point; 0 at a fixed point.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> figures = lin.certificate
    >>> figures.route_A < 1e-12, figures.inertia_residual < 1e-12
    (True, True)
    """

    condition: float
    inertia_residual: float
    route_A: float
    route_B: float
    f0: float


@dataclass(frozen=True, eq=False, repr=False)
class LinearModel(FrozenArrays):
    r"""A linear model about a point, ``dx/dt = f0 + A (x - x0) + B (u - u0)``.

    The output is ``y = y0 + C (x - x0) + D (u - u0)``. For ``dt > 0`` the left side is the next
    sample's ``x - x0`` instead and f0 what is added at each step. Arrays are read-only.

    Attributes
    ----------
    A : ndarray (nx, nx)
    B : ndarray (nx, nu)
    C : ndarray (ny, nx)
    D : ndarray (ny, nu)
    f0 : ndarray (nx,)
        Nonlinear right-hand side at the point; zero exactly at a fixed point.
    x0, u0, y0 : ndarray
        State, input and output at the point.
    dt : float
        Sampling time [s]; 0 for continuous time.
    state_names, input_names, output_names : tuple of str
    state_units, input_units, output_units : tuple of str
    frame : str
        "hybrid", "local" or "world": axes of velocities and wrenches; in orbit "lvlh" or "hill".
    moving : bool
        Whether the state is the error from a reference that moves through the point.
    q : ndarray (nq,)
        Configuration of the point in Pinocchio's order.
    v : ndarray (nv,)
        Velocity of the point in Pinocchio's order.
    robot : str
        Name of the robot.
    urdf_sha256 : str
        Hash of the URDF as it was read; empty where there was none.
    locked : tuple of str
        "joint=value" [rad|m] of the joints that are welded in it.
    fflin_version, pinocchio_version : str
        What made the model.
    verified : bool
        Whether it is as it was made; False of a file that has no digest to tell damage by, and of
        what is made of it.
    weights : mapping
        What `lqr` weighs where it is given nothing, as `Robot.replace` takes it.
    mean_motion : float
        Of the orbit [rad/s] in whose frame the robot is; 0 where there is none.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> lin.state_names[:3], lin.input_units[0]
    (('q_b.x', 'q_b.y', 'q_b.z'), 'N m')
    >>> sampled = lin.discretize(0.1)
    >>> lin.save("model.mat")
    >>> fflin.LinearModel.load("model.mat").dt, sampled.dt
    (0.0, 0.1)
    """

    A: Array
    B: Array
    C: Array
    D: Array
    f0: Array
    x0: Array
    u0: Array
    y0: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    frame: Frame
    moving: bool
    q: Array
    v: Array
    robot: str
    urdf_sha256: str
    locked: tuple[str, ...]
    fflin_version: str
    pinocchio_version: str
    _reference: Array = field()
    _inertia: Callable[[LinearModel], Array] = field()
    _certify: Callable[[LinearModel], Certificate] = field()
    _ignorable: Callable[[LinearModel], tuple[str, ...]] | None = None
    _drift: Array | None = None
    # Of a sampled model: its own fingerprint and the continuous model that it was made of, whose
    # structure no exponential has blurred.
    _source: tuple[str, LinearModel] | None = None
    verified: bool = True
    _limits: Callable[[], Mapping[str, float]] | None = None
    weights: Mapping[str, Any] = field(default_factory=dict)
    _robot: Robot | None = None  # that it was made of; None where it is from a file
    mean_motion: float = 0.0

    @classmethod
    def from_fields(cls, values: dict[str, Any]) -> LinearModel:
        """Return a model of fields; those under ``_when_asked`` are functions of q."""
        # The generated __init__ sets two dozen frozen fields one by one, which takes as long
        # as the dynamics of a small robot.
        lin = _new(cls)
        _set(lin, "__dict__", values)
        return lin

    def __getattr__(self, name: str) -> Any:
        # At rest some fields take as long to make as the dynamics, so they wait until asked for.
        make = vars(self).get("_when_asked", {}).get(name)
        if make is None:
            raise AttributeError(f"'LinearModel' object has no attribute '{name}'")
        return vars(self).setdefault(name, make(self.q))

    def __repr__(self) -> str:
        nx, nu = self.B.shape
        time = f"dt={self.dt:g} s" if self.dt else "continuous"
        return f"LinearModel('{self.robot}', nx={nx}, nu={nu}, frame='{self.frame}', {time})"

    def __str__(self) -> str:
        from fflin.base.record import NOT_VERIFIED

        return repr(self) if self.verified else f"{self!r}\n{NOT_VERIFIED}"

    @property
    def reference(self) -> pin.SE3:
        """Placement oMref that attitude and position are relative to."""
        import pinocchio as pin

        return pin.XYZQUATToSE3(self.placement)

    @property
    def placement(self) -> Array:
        """`reference` (7,) as its position [m] and quaternion x, y, z, w."""
        return self._reference

    @property
    def drift(self) -> Array | None:
        """Own rate (nx,) of a moving reference, whose f0 is zero by construction; else None.

        That of its attitude is without turns about gravity, which change nothing.
        """
        return self._drift

    @cached_property
    def M(self) -> Array:
        """Joint-space inertia (6 + n, 6 + n) in state order, angular first, and frame's axes."""
        return self._inertia(self)

    @property
    def fingerprint(self) -> str:
        """Hash of A, B and f0, which a certificate is about."""
        digest = sha256()
        for array in (self.A, self.B, self.f0):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()

    def require(self, fingerprint: str) -> None:
        """Raise `InputError` where the matrices are not those that were certified."""
        if self.fingerprint != fingerprint:
            raise InputError(
                "A, B or f0 were changed after they were certified; hold them against the robot "
                "with fflin.check"
            )

    def require_unchanged(self) -> None:
        """Raise `ModelError` where the robot was changed in place after it was made."""
        if self._robot is not None:
            self._robot.require_unchanged()

    @property
    def generator(self) -> LinearModel | None:
        """The continuous model that this is sampled from, or itself.

        None where that is not known: of a file, or of matrices that were changed.
        """
        if not self.dt:
            return self
        known = self._source is not None and self._source[0] == self.fingerprint
        return self._source[1] if self._source and known else None

    @cached_property
    def certificate(self) -> Certificate:
        """The figures that prove the model, computed when first asked for."""
        return self._certify(self)

    @cached_property
    def ignorable(self) -> tuple[str, ...]:
        """The states that nothing in the model depends on, found on the robot.

        Where the base is, and the angles of rotors; with `moving`, without gravity, the attitude
        too; in orbit the latter alone. A rotor is symmetric about its axis and carries nothing.
        """
        return () if self._ignorable is None else self._ignorable(self)

    @cached_property
    def limits(self) -> Mapping[str, float]:
        """{name of an input or state: limit} of those that have one, found on the robot.

        Of inputs the largest force or torque, of ``qdot_m`` the largest speed [rad/s | m/s], of
        ``q_m`` the whole travel [rad | m]; of the URDF, the inputs and `Robot.limits`.
        """
        return {} if self._limits is None else self._limits()

    def is_equilibrium(self, tol: float = 1e-9) -> bool:
        """Whether the point is a fixed point or a relative equilibrium, so that A and B stay.

        At a relative equilibrium only ignorable coordinates move, at constant rates: a rotor
        spins, or the base flies along. With ``moving=True`` the motion of the reference is
        judged, not f0: its velocities in base axes must be constant, its joints stand but for
        rotors, and under gravity it may turn about the vertical only.

        Parameters
        ----------
        tol : float
            What no rate may exceed, in SI units; those of ignorable coordinates may. In orbit
            times its mean motion, since its field is weak.
        """
        rate = self.f0 if self.drift is None else self.drift
        judged = [name not in self.ignorable for name in self.state_names]
        return bool(np.abs(rate[judged]).max(initial=0.0) <= self.bound(number("tol", tol)))

    def bound(self, tol: float) -> float:
        """Return what a tolerance is of rates at an equilibrium."""
        return tol * min(1.0, self.mean_motion or 1.0)

    def discretize(self, dt: float) -> LinearModel:
        r"""Sample the model with its input held constant between samples.

        .. math::
            A_d = e^{A h}, \quad [B_d, f_d] = \int_0^h e^{A s}\,ds\,[B, f_0]

        At rest A^2 = 0, and the series ends: :math:`A_d = E + A h`, :math:`B_d = B h + A B h^2/2`,
        (2.2) of docs/derivation.md.

        Parameters
        ----------
        dt : float
            Sampling time h [s], positive.

        Returns
        -------
        LinearModel
            With ``dt`` set; its certificate is the continuous model's.

        Raises
        ------
        InputError
            If `dt` is not positive or the model is sampled already.
        ModelError
            If the robot's model was changed after it was made.
        """
        self.require_unchanged()
        dt = number("dt", dt)
        if dt <= 0.0:
            raise InputError(f"dt is {dt:g} s, expected a positive sampling time")
        if self.dt:
            raise InputError(f"the model is sampled already, at dt = {self.dt:g} s")
        Ad, held = held_exponential(self.A, np.column_stack((self.B, self.f0)), dt)
        if not (np.isfinite(Ad).all() and np.isfinite(held).all()):
            raise InputError(f"dt is {dt:g} s, over which the model grows beyond all numbers")
        sampled = replace(
            self, A=Ad, B=held[:, :-1], f0=held[:, -1], dt=dt, _inertia=partial(_same_M, self)
        )
        certify = partial(same_certificate, self, sampled.fingerprint)
        return replace(sampled, _certify=certify, _source=(sampled.fingerprint, self))

    def to(self, tool: str, *, dt: float | None = None) -> ToolModel:
        """Return the model in another tool's coordinates: `transform`, of its own robot."""
        from fflin import transform

        if self._robot is None:
            raise InputError("this model's robot is not known: fflin.transform(robot, lin, tool)")
        return transform(self._robot, self, tool, dt=dt)

    def to_scipy(self) -> Any:
        """Return a `scipy.signal.StateSpace` of the deviations; names and f0 are lost."""
        from scipy.signal import StateSpace

        self.require_unchanged()
        matrices = (self.A, self.B, self.C, self.D)
        return StateSpace(*matrices, dt=self.dt) if self.dt else StateSpace(*matrices)

    def to_control(self) -> Any:
        """Return a `control.StateSpace` of the deviations, with signal names; f0 is lost.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        ModelError
            If the robot's model was changed after it was made.
        """
        self.require_unchanged()
        matrices = (self.A, self.B, self.C, self.D)
        return state_space(matrices, self.dt, self.state_names, self.input_names, self.output_names)

    def save(self, path: str | Path) -> None:
        """Write the model and its certificate, whole or not at all.

        Parameters
        ----------
        path : str or Path
            Ends in .npz, .mat, .json, or .csv (then one file per matrix, NAME.A.csv and so on).

        Raises
        ------
        FileError
            If the ending is another or the file cannot be written.
        InputError
            If a figure is not finite.
        """
        from fflin.base.writing import as_path
        from fflin.linear.files import record_of, write_model

        write_model(as_path(path), record_of(self), sealed=self.verified)

    @staticmethod
    def load(path: str | Path) -> LinearModel:
        """Read a model that `save` wrote; every figure is the same to the last bit.

        Raises
        ------
        FileError
            If the file cannot be read, is damaged or is not such a model.
        """
        from fflin.base.writing import as_path
        from fflin.linear.files import given, read_model

        values, certificate = read_model(as_path(path))
        lin = LinearModel(**values, _certify=partial(given, Certificate(**certificate)))
        return replace(lin, _certify=partial(same_certificate, lin, lin.fingerprint))


def state_space(matrices: Any, dt: float, *signals: Sequence[str]) -> Any:
    """Return a `control.StateSpace` of A, B, C, D and names of states, inputs and outputs."""
    try:
        import control
    except ImportError:
        raise MissingPackageError(
            "to_control needs python-control; install it with: pip install 'fflin[control]'"
        ) from None
    # python-control reserves dots in signal names for its own system.signal syntax.
    states, inputs, outputs = ([name.replace(".", "_") for name in each] for each in signals)
    return control.ss(*matrices, dt, states=states, inputs=inputs, outputs=outputs)


def _same_M(continuous: LinearModel, _: LinearModel) -> Array:
    return continuous.M


def same_certificate(whole: LinearModel, fingerprint: str, made: LinearModel) -> Certificate:
    """Return the certificate of what a model was made of, which that of a fingerprint has too."""
    made.require(fingerprint)
    return whole.certificate
