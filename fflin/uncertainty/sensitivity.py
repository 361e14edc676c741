"""Exact derivatives of a linear model with respect to the robot's parameters."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np

from fflin.base import html
from fflin.base.errors import InputError
from fflin.base.record import Record, write_record
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, FrozenArrays, instance, numbers, shaped, whole
from fflin.base.writing import as_path
from fflin.control.gain import Gain, gain_matrix
from fflin.linear.files import record_of
from fflin.linear.model import LinearModel, refuse_delayed, refuse_frozen
from fflin.uncertainty.derivatives import ModelDerivatives
from fflin.uncertainty.lagging_derivatives import LaggingDerivatives
from fflin.uncertainty.parameters import Parameter, Parameters

# Poles count as equal if their distance, relative to the largest pole, is smaller than this. Equal
# poles have no derivative.
_EQUAL = 1e-6
_ROUNDING = 1e-12  # smaller effects, relative to the largest entry, are rounding errors


@dataclass(frozen=True, eq=False, repr=False)
class Derivatives(FrozenArrays):
    """Derivatives of a linear model with respect to one parameter, or along a direction.

    Attributes
    ----------
    name, unit : str
        Name and unit of the parameter. Derivatives are per this unit.
    value : float
        Value of the parameter; 0 for a direction.
    dA, dB, dC, dD : ndarray
        Derivatives, with the shapes of A, B, C and D.
    df0, dy0 : ndarray (nx,), (ny,)
        Derivatives of the state's rate and of the outputs at the point, for constant state and
        inputs. For a sampled model, the change of the state in one sample replaces the rate. For a
        model with `moving`, df0 is the rate at which a robot with the changed parameter departs
        from the reference.
    """

    name: str
    unit: str
    value: float
    dA: Array
    dB: Array
    dC: Array
    dD: Array
    df0: Array
    dy0: Array

    def __repr__(self) -> str:
        return f"Derivatives('{self.name}' = {self.value:.6g} {self.unit}, nx={len(self.dA)})"


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity:
    """Derivatives of a linear model with respect to the parameters of the robot.

    ``S["arm.mass"].dA`` is the derivative of A with respect to one parameter. Most parameters
    belong to a link or to a body. The name of a link is its name in the URDF. A body is a group of
    links that are fixed to each other; its name is the name of its joint, or ``base``. The
    parameters of a link or body are

    - ``LINK.mass`` [kg]; centre of mass and inertia about the centre of mass stay constant;
    - ``LINK.com.x`` [m] in the link's axes; mass and inertia about the centre of mass stay
      constant;
    - ``LINK.inertia.xx`` .. ``.yz`` [kg m^2] about the centre of mass, in the axes of the URDF's
      <inertial> for a link, or in the axes of its joint for a body;
    - ``LINK.density``, a factor that multiplies mass and inertia.

    A pattern selects links, or bodies if the pattern matches no link.

    A mode of a flexible appendage or slosh has the parameters ``MODE.frequency`` [Hz] and
    ``MODE.damping`` (the damping ratio), both for a clamped link. The damping ratio stays constant
    if the frequency is changed.

    Other parameters are ``JOINT.stiffness``, ``JOINT.damping``, ``THRUSTER.position.x`` [m],
    ``THRUSTER.direction.x``, ``THRUSTER.torque`` [m] if it is nonzero, and ``WHEEL.inertia``. A
    change of the length of ``THRUSTER.direction`` has no effect. The inertia of a wheel's carrier
    includes the wheel, so a larger wheel inertia reduces the inertia of the rest of the carrier.

    Attributes
    ----------
    lin : LinearModel
        Linear model whose derivatives are computed.
    parameters : Parameters
        Mapping from names to the parameters of the robot.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> S = fflin.sensitivity(lin)
    >>> heavier = S.along({"base.density": 0.1})
    >>> (lin.B + heavier.dB).shape
    (18, 9)
    >>> len(S.names) > 30
    True
    """

    lin: LinearModel
    parameters: Parameters
    _derivatives: ModelDerivatives = field()

    def __repr__(self) -> str:
        return f"Sensitivity('{self.lin.robot}', {len(self.parameters)} parameters)"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.parameters)

    def __getitem__(self, name: str) -> Derivatives:
        """Return the derivatives with respect to one parameter."""
        one = self._one(name)
        matrices = self._derivatives.over([one])
        first = [matrix[0] for matrix in matrices]
        return Derivatives(one.name, one.unit, one.value, *first)

    def _one(self, name: str) -> Parameter:
        names = self.parameters.find(name)
        if len(names) > 1:
            raise InputError(
                f"'{name}' matches {len(names)} parameters, expected one; to change several "
                "parameters together, use along({...})"
            )
        return self.parameters[names[0]]

    def along(self, direction: Mapping[str, float]) -> Derivatives:
        """Return the derivatives for a simultaneous change of several parameters.

        Parameters
        ----------
        direction : mapping
            Changes {parameter or pattern: change}, each in the parameter's unit. The results are
            the first-order changes of A, B and so on for these changes. For example, the change
            0.1 of ``payload.density`` increases mass and inertia of the payload by a tenth, and
            the change 1.0 of ``panel_*.stiffness`` changes all matching stiffnesses together.
        """
        given = numbers("direction", direction, "parameter", "change")
        named = {
            name: value
            for key, value in given.items()
            for name in self.parameters.find(key)
        }
        if not named:
            raise InputError("direction is empty, expected {parameter: change}")
        matrices = self._derivatives.over([self.parameters[name] for name in named])
        changes = [*named.values()]
        dA, dB, dC, dD, df0, dy0 = (np.tensordot(changes, x, 1) for x in matrices)
        return Derivatives(
            name=" + ".join(given),
            unit="1",
            value=0.0,
            dA=dA,
            dB=dB,
            dC=dC,
            dD=dD,
            df0=df0,
            dy0=dy0,
        )

    @cached_property
    def _all(self) -> tuple[Array, ...]:
        return self._derivatives.over(list(self.parameters.values()))

    @property
    def dA(self) -> Array:
        """Derivatives (P, nx, nx) of A with respect to each parameter."""
        return self._all[0]

    @property
    def dB(self) -> Array:
        """Derivatives (P, nx, nu) of B with respect to each parameter."""
        return self._all[1]

    @property
    def df0(self) -> Array:
        """Derivatives (P, nx) of f0 with respect to each parameter."""
        return self._all[4]

    def poles(self, gain: object = None) -> tuple[Array, Array]:
        """Return the closed-loop poles (nx,) of A - B K and their derivatives (P, nx).

        Parameters
        ----------
        gain : Gain or array_like (nu, nx), optional
            Gain K; zero by default, for the poles of A.

        Returns
        -------
        poles, derivatives : ndarray
            Poles, and one row of derivatives per parameter. Derivatives of coincident poles are
            NaN, because such poles are not differentiable.
        """
        lin = self.lin
        A, B, dA, dB = lin.A, lin.B, self.dA, self.dB
        K: Array = np.zeros(B.T.shape)
        if isinstance(gain, Gain) and gain.integrals:
            # The integrals are further states, on which the parameters have no direct effect.
            if gain.model_states != lin.state_names or gain.dt:
                raise InputError(
                    f"the gain was designed for a model of '{gain.robot}' with other states or in "
                    "discrete time; give a continuous gain of the model of the same robot"
                )
            more = len(gain.integrals)
            A, B = gain.A, gain.B
            dA = np.pad(dA, ((0, 0), (0, more), (0, more)))
            dB = np.pad(dB, ((0, 0), (0, more), (0, 0)))
        if gain is not None:
            K = shaped("gain", gain_matrix(gain), B.T.shape, " (nu, nx)")
        from scipy.linalg import eig

        poles, left, right = eig(A - B @ K, left=True)
        changes = dA - dB @ K
        derivatives = np.einsum(
            "ik,pij,jk->pk", left.conj(), changes, right, optimize=True
        )
        derivatives = derivatives / np.einsum("ik,ik->k", left.conj(), right)
        apart = np.abs(poles[:, None] - poles)
        np.fill_diagonal(apart, np.inf)
        derivatives[
            :, apart.min(axis=1) <= _EQUAL * max(np.abs(poles).max(), _EQUAL)
        ] = np.nan
        return poles, derivatives

    def check(self, names: Sequence[str] | None = None) -> dict[str, float]:
        """Compare the derivatives of A and B with finite differences.

        The finite differences are independent of the exact derivatives: each parameter is changed
        by small steps, and A and B are computed at each step from Pinocchio's derivatives of ABA.

        Parameters
        ----------
        names : sequence of str, optional
            Parameters of links and bodies; by default all of them.

        Returns
        -------
        dict
            Largest differences {parameter: difference}, relative to the derivatives. Differences
            of about 1e-9 are expected, which is the accuracy of the finite differences, or of about
            1e-7 if constraints are redundant.

        Raises
        ------
        InputError
            If `names` is not a list, or a parameter is not of a link or body; or if the robot has
            both constraints and mimic joints, which Pinocchio's derivatives do not support.
        """
        if names is None:
            names = [name for name, one in self.parameters.items() if one.bodies]
        if not isinstance(names, list | tuple) or not all(
            isinstance(name, str) for name in names
        ):
            raise InputError(
                f"names is {names!r}, expected a list, such as ['base.mass']"
            )
        return {name: self._derivatives.difference(self._one(name)) for name in names}

    def __str__(self) -> str:
        """Return `table` with its default arguments."""
        return self.table()

    def table(self, top: int = 15, only: str | None = None) -> str:
        """Return a table of the parameters with the largest effect on A and B.

        The effect of a parameter is the change of A and B if the parameter changes by 10 %, or by
        1 cm for a position or a centre of mass.

        Parameters
        ----------
        top : int
            Number of rows.
        only : str, optional
            Parameters to which the table is restricted: a kind such as ``mass``, a link such as
            ``link_3``, or a pattern such as ``*.density``. Bodies whose links are listed are
            omitted.
        """
        title, table, left = self._ranked(top, only)
        if not table:
            return title
        lines = [folded([title]), "", grid(table, "ll")]
        if left:
            lines.append(f"... and {left} more, see --top")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        title, table, left = self._ranked(15, None)
        more = f"... and {left} more, see table(top={15 + left})" if left else ""
        rows = html.table(table, "ll") if table else ""
        return html.result_card(self, html.paragraph(title), rows, html.paragraph(more))

    def _ranked(
        self, top: int, only: str | None
    ) -> tuple[str, list[tuple[str, ...]], int]:
        """Return the title and the rows of `table`, and the number of rows that are left out."""
        instance(
            "only", only, (str, type(None)), "the name of a kind, a link or a pattern"
        )
        shown = self.parameters.ranked(only)
        lin = self.lin
        sizes = [np.abs(x).max(initial=1e-300) for x in (self.lin.A, self.lin.B)]
        rows = []
        for one, dA, dB in zip(self.parameters.values(), self.dA, self.dB, strict=True):
            small = one.part.partition(".")[0] in ("com", "position")
            step = 0.1 * abs(one.value)
            if not one.value and one.part.startswith("direction"):
                step = 0.1
            if small:
                step = 0.01
            effect = [
                step * np.abs(d).max(initial=0.0) / size
                for d, size in zip((dA, dB), sizes, strict=True)
            ]
            if one.name in shown and max(effect) > 0.0:
                unit = "." if one.unit == "1" else one.unit
                percents = (
                    f"{100.0 * x:.2g}" if x > _ROUNDING else "." for x in effect
                )
                cells = one.name, unit, f"{one.value:.5g}", f"{step:.3g}", *percents
                rows.append((max(effect), *cells))
        rows.sort(key=lambda row: -row[0])
        most = [row[1:] for row in rows[: whole("top", top, 1)]]
        if not most:
            return f"{lin.robot}: none of these parameters changes A or B", [], 0
        name, unit, _, step, *_ = most[0]
        change = step if unit == "." else f"{step} {unit}"
        title = (
            f"{lin.robot}: {name} changes A and B most: if it changes by {change}, A or B "
            f"changes by {100.0 * rows[0][0]:.2g} % of its largest entry, to first order"
        )
        heads = ("parameter", "unit", "value", "change", "A [%]", "B [%]")
        return title, [heads, *most], max(0, len(rows) - top)

    def save(self, path: str | Path) -> None:
        """Write the derivatives to a .npz, .mat or .json file, atomically.

        In addition to the keys of the model, the file contains parameters, units and values (P,),
        dA (P, nx, nx), dB (P, nx, nu), dC, dD, df0 and dy0.

        Raises
        ------
        FileError
            If the file has another ending or cannot be written.
        """
        write_record(
            as_path(path), sensitivity_record(self), checksummed=self.lin.verified
        )


def sensitivity_record(result: Sensitivity) -> Record:
    """Return the entries that a file stores for a `Sensitivity`."""
    every = result.parameters.values()
    return record_of(result.lin) | {
        "parameters": list(result.names),
        "units": [one.unit for one in every],
        "values": np.array([one.value for one in every]),
        **dict(zip(("dA", "dB", "dC", "dD", "df0", "dy0"), result._all, strict=True)),
    }


def sensitivity(lin: LinearModel) -> Sensitivity:
    r"""Return the exact derivatives of a linear model with respect to the robot's parameters.

    The inertia matrix M and the inverse dynamics (RNEA) are linear in the dynamic parameters of the
    bodies. Therefore the equations of the linear model can be differentiated exactly. For example,
    the derivative of :math:`M^{-1}` with respect to a parameter p is
    :math:`(M^{-1})_p = -M^{-1} M_p M^{-1}`; see docs/derivation.md. If the robot has constraints,
    the derivatives belong to the model in its independent states, at rest or in motion, and
    include the forces in the loops.

    Parameters
    ----------
    lin : LinearModel
        Result of `linearize` in this session, about any operating point and in any frame. If
        `discretize` returned the model, the discrete-time A, B and f0 are differentiated.

    Returns
    -------
    Sensitivity
        Derivatives of the model, which are computed at first access.

    Raises
    ------
    InputError
        If the model was loaded from a file, or contains delays. Lags are supported.
    ModelError
        If the robot's Pinocchio model (``robot.model``) was modified after the robot was created.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> S = fflin.sensitivity(lin)
    >>> S["base.mass"].dB.shape, bool(S["base.mass"].dA.any())
    ((18, 9), False)
    """
    robot = instance("lin", lin, LinearModel, "a fflin.LinearModel")._robot
    if robot is None:
        raise InputError(
            "the model was loaded from a file, which contains no robot; linearise the robot again"
        )
    refuse_frozen(lin, "sensitivity")
    if lin.delay.any():
        refuse_delayed(lin, "sensitivity")
    if robot.orbit and lin.frame == "local":
        raise InputError(
            f"sensitivities in base axes are defined only without an orbit, but '{robot.name}' is "
            "in orbit; linearise in frame 'lvlh' or 'hill'"
        )
    source = lin.generator
    if source is None:
        raise InputError(
            "the continuous model of this sampled model is not known; sample one with discretize"
        )
    lin.require_unchanged()
    derivatives: ModelDerivatives
    if lin.added:
        derivatives = LaggingDerivatives(lin, robot, source)
    else:
        derivatives = ModelDerivatives(lin, robot, source)
    return Sensitivity(lin, Parameters(robot), derivatives)
