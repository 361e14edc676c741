"""Exact derivatives of a linear model over the parameters of its robot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fflin.base.errors import InputError
from fflin.base.frozen import FrozenArrays
from fflin.base.record import write_record
from fflin.base.tables import folded, grid
from fflin.base.validation import Array, as_double, numbers, whole
from fflin.base.writing import as_path
from fflin.linear.files import record_of
from fflin.linear.model import LinearModel
from fflin.uncertainty.model_slopes import ModelSlopes, difference
from fflin.uncertainty.parameters import Parameter, Parameters

# Poles closer than this, relative to the largest, have no derivative of their own.
_EQUAL = 1e-6


@dataclass(frozen=True, eq=False, repr=False)
class Slope(FrozenArrays):
    """Derivatives of a linear model over one parameter, or along a direction of several.

    Attributes
    ----------
    name, unit : str
        Of the parameter; what is derived is per unit of it.
    value : float
        What the parameter is; of a direction 0.
    dA, dB, dC, dD : ndarray
        Of the shape of A, B, C and D.
    df0, dy0 : ndarray (nx,), (ny,)
        Of the state's rate and the outputs at the point, state and inputs held. Of a model with
        `moving`, df0 is the rate at which a robot with other parameters leaves the reference.
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
        return f"Slope('{self.name}' = {self.value:.6g} {self.unit}, nx={len(self.dA)})"


@dataclass(frozen=True, eq=False, repr=False)
class Sensitivity:
    """Derivatives of a linear model over every parameter of its robot; ``S["arm.mass"].dA``.

    The parameters are, of each link by its name in the URDF, and of each body, links that are
    fixed to each other, by its joint or as ``base``:

    - ``LINK.mass`` [kg], its centre of mass and inertia about it held;
    - ``LINK.com.x`` [m] in the link's axes, mass and inertia about it held;
    - ``LINK.inertia.xx`` .. ``.yz`` [kg m^2] about the centre of mass, in the axes of the URDF's
      <inertial>; of a body, in its joint's;
    - ``LINK.density``, of the whole link, relative; ``BODY.mass`` of `monte_carlo` is one too;

    and ``JOINT.stiffness``, ``JOINT.damping``, ``THRUSTER.position.x`` [m],
    ``THRUSTER.direction.x`` (what of it turns the unit vector) and ``WHEEL.inertia``, which the
    carrier's inertia counts.

    Attributes
    ----------
    lin : LinearModel
    parameters : Parameters
        {name: Parameter} in the robot's order.

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
    _slopes: ModelSlopes = field()

    def __repr__(self) -> str:
        return f"Sensitivity('{self.lin.robot}', {len(self.parameters)} parameters)"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.parameters)

    def __getitem__(self, name: str) -> Slope:
        """Return the derivatives over one parameter."""
        one = self._one(name)
        return Slope(one.name, one.unit, one.value, *(x[0] for x in self._slopes.over([one])))

    def _one(self, name: str) -> Parameter:
        found = self.parameters.find(name)
        if len(found) > 1:
            raise InputError(f"'{name}' stands for {len(found)} parameters; take along({{...}})")
        return self.parameters[found[0]]

    def along(self, direction: Mapping[str, float]) -> Slope:
        """Return the derivatives along a direction.

        Parameters
        ----------
        direction : mapping
            {parameter or pattern: change of it for a unit of the direction, in its unit}.
            ``{"payload.density": 0.1}`` is a payload that is heavier by a tenth, all of its
            inertia with it; ``{"panel_*.stiffness": 1.0}`` all of these at once.
        """
        given = numbers("direction", direction, "parameter", "change")
        named = {name: value for key, value in given.items() for name in self.parameters.find(key)}
        if not named:
            raise InputError("direction is empty, expected {parameter: change}")
        matrices = self._slopes.over([self.parameters[name] for name in named])
        weights = [*named.values()]
        return Slope(" + ".join(given), "1", 0.0, *(np.tensordot(weights, x, 1) for x in matrices))

    @cached_property
    def _all(self) -> tuple[Array, ...]:
        return self._slopes.over(list(self.parameters.values()))

    @property
    def dA(self) -> Array:
        """Derivatives (P, nx, nx) of A over each parameter."""
        return self._all[0]

    @property
    def dB(self) -> Array:
        """Derivatives (P, nx, nu) of B over each parameter."""
        return self._all[1]

    @property
    def df0(self) -> Array:
        """Derivatives (P, nx) of f0 over each parameter."""
        return self._all[4]

    def poles(self, gain: Any = None) -> tuple[Array, Array]:
        """Return the poles (nx,) of A - B K and their derivatives (P, nx).

        Parameters
        ----------
        gain : Gain or array_like (nu, nx), optional
            K; zero by default.

        Returns
        -------
        poles, slopes : ndarray
            NaN where poles coincide, which have no derivative: they part like a root.
        """
        lin = self.lin
        K = np.zeros(lin.B.T.shape) if gain is None else getattr(gain, "K", gain)
        K = as_double("gain", K)
        if K.shape != lin.B.T.shape:
            raise InputError(f"gain has shape {K.shape}, expected {lin.B.T.shape} (nu, nx)")
        from scipy.linalg import eig

        poles, left, right = eig(lin.A - lin.B @ K, left=True)
        changes = self.dA - self.dB @ K
        slopes = np.einsum("ik,pij,jk->pk", left.conj(), changes, right, optimize=True)
        slopes = slopes / np.einsum("ik,ik->k", left.conj(), right)
        apart = np.abs(poles[:, None] - poles)
        np.fill_diagonal(apart, np.inf)
        slopes[:, apart.min(axis=1) <= _EQUAL * max(np.abs(poles).max(), _EQUAL)] = np.nan
        return poles, slopes

    def check(self, names: Sequence[str] | None = None) -> dict[str, float]:
        """Hold derivatives of A and B against differences of another route to them.

        The robot is changed by small steps, and A and B are built from the derivatives of ABA.

        Parameters
        ----------
        names : sequence of str, optional
            Parameters of bodies; all of them by default.

        Returns
        -------
        dict
            {parameter: largest difference, relative to what it changes of A and B}: of the order
            1e-9, the differences' own.
        """
        if names is None:
            names = [name for name, one in self.parameters.items() if one.bodies]
        if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
            raise InputError(f"names is {names!r}, expected several, such as ['base.mass']")
        return {name: difference(self._slopes, self._one(name)) for name in names}

    def __str__(self) -> str:
        """Tell what 10 % of each parameter changes, the most first; 1 cm of a centre of mass."""
        return self.table()

    def table(self, top: int = 15, only: str | None = None) -> str:
        """Return the `top` rows of what 10 % of a parameter changes, or 1 cm, the most first.

        Only of ``mass``, ``link_3``, ``*.density``; bodies stand beside no links of theirs.
        """
        shown = self.parameters.ranked(only)
        lin, sizes = self.lin, [max(np.abs(x).max(), 1e-300) for x in (self.lin.A, self.lin.B)]
        rows = []
        for one, dA, dB in zip(self.parameters.values(), self.dA, self.dB, strict=True):
            small = one.part.partition(".")[0] in ("com", "position")
            step = 0.01 if small else 0.1 * (abs(one.value) or float(one.part[:9] == "direction"))
            effect = [step * np.abs(d).max() / of for d, of in zip((dA, dB), sizes, strict=True)]
            if one.name in shown and max(effect) > 0.0:
                unit = "." if one.unit == "1" else one.unit
                shares = (f"{100.0 * x:.2g}" for x in effect)
                rows.append(
                    (max(effect), one.name, unit, f"{one.value:.5g}", f"{step:.3g}", *shares)
                )
        rows.sort(key=lambda row: -row[0])
        most = [row[1:] for row in rows[: whole("top", top, 1)]]
        if not most:
            return f"{lin.robot}: none of these parameters changes A or B"
        largest = f"{most[0][0]} changes A and B most, by {100.0 * rows[0][0]:.2g} %"
        title = folded([f"{lin.robot}: {largest} of their largest entry, to first order"])
        heads = ("parameter", "unit", "value", "change", "A [%]", "B [%]")
        more = f"... and {len(rows) - top} more, see --top"
        return "\n".join([title, grid([heads, *most], "ll"), *[more] * (len(rows) > top)])

    def save(self, path: str | Path) -> None:
        """Write the derivatives to a .npz, .mat or .json file, whole or not at all.

        Besides the model's own keys parameters, units and values (P,), dA (P, nx, nx),
        dB (P, nx, nu), dC, dD, df0 and dy0.

        Raises
        ------
        FileError
            If the ending is another or the file cannot be written.
        """
        every = self.parameters.values()
        record = record_of(self.lin) | {
            "parameters": list(self.names),
            "units": [one.unit for one in every],
            "values": np.array([one.value for one in every]),
            **dict(zip(("dA", "dB", "dC", "dD", "df0", "dy0"), self._all, strict=True)),
        }
        write_record(as_path(path), record, sealed=self.lin.verified)


def sensitivity(lin: LinearModel) -> Sensitivity:
    r"""Differentiate a linear model over the parameters of its robot, exactly.

    M and RNEA are linear in the dynamic parameters of bodies, so that derivatives of A, B and f0
    are those of the linear model's own equations:
    :math:`(M^{-1})_p = -M^{-1} M_p M^{-1}` and so on; docs/derivation.md has them.

    Parameters
    ----------
    lin : LinearModel
        Made by `linearize` in this session, about any point and in any frame; of one that
        `discretize` sampled, derivatives are those of its A, B and f0 over a sample.

    Returns
    -------
    Sensitivity
        Derivatives are computed when they are asked for.

    Raises
    ------
    InputError
        If the model is from a file.
    ModelError
        If the robot was changed after the model was made.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> S = fflin.sensitivity(lin)
    >>> S["base.mass"].dB.shape, bool(S["base.mass"].dA.any())
    ((18, 9), False)
    """
    if not isinstance(lin, LinearModel):
        raise InputError(f"lin is a {type(lin).__name__}, expected a LinearModel of linearize")
    robot = lin._robot
    if robot is None:
        raise InputError("the model is from a file, without its robot; make it with linearize")
    source = lin.generator
    if source is None:
        raise InputError("the model is sampled from one that is not known; make it by discretize")
    lin.require_unchanged()
    return Sensitivity(lin, Parameters(robot), ModelSlopes(lin, robot, source))
