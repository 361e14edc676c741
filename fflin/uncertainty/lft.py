r"""Linear-fractional models: A and B as exact functions of uncertain parameters.

:math:`\dot x = A x + B_1 w + B_2 u,\; z = C_1 x + D_{11} w + D_{12} u,\; w = \Delta z` with
:math:`\Delta = \mathrm{diag}(\delta_k E_{r_k})`, each :math:`\delta_k` between -1 and 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from fflin.base.errors import InputError
from fflin.base.names import matching
from fflin.base.record import Design
from fflin.base.tables import counted, cut, folded, grid
from fflin.base.validation import Array, as_double, numbers
from fflin.linear.model import state_space

if TYPE_CHECKING:
    import control


@dataclass(frozen=True, eq=False, repr=False)
class LFT(Design):
    r"""Uncertain linear model in linear-fractional form (LFT), exact in its parameters.

    .. math:: \dot x = A x + B_1 w + B_2 u,\quad z = C_1 x + D_{11} w + D_{12} u,\quad
              y = C_2 x + D_{21} w + D_{22} u,\quad w = \Delta z

    Each uncertain parameter has a normalised value delta between -1 and 1. :math:`\Delta` is a
    diagonal matrix that contains every delta one or more times. ``print`` shows the range of every
    parameter and the number of its repetitions.

    Attributes
    ----------
    A, B1, B2 : ndarray (nx, nx), (nx, nw), (nx, nu)
        Matrices of the state equation.
    C1, D11, D12 : ndarray (nw, nx), (nw, nw), (nw, nu)
        Matrices of z.
    C2, D21, D22 : ndarray (ny, nx), (ny, nw), (ny, nu)
        Matrices of the outputs y.
    parameters : tuple of str
        Uncertain parameters in the order in which their deltas occur in :math:`\Delta`. Tied
        parameters, which share one delta, are listed once, under their pattern.
    repeats : ndarray (k,)
        Number of times that each delta occurs in :math:`\Delta`.
    middle, half : ndarray (k,)
        Middle and half width of each range: a parameter has the value ``middle + half * delta``.
        For tied parameters, ``middle + half * delta`` is their common value if their range was
        given as a pair. If their range is relative, ``middle + half * delta`` is the factor that
        multiplies their nominal values.
    units : tuple of str
        Units of the parameters; "1" for a factor.
    state_names, input_names, output_names : tuple of str
    robot : str

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lft = fflin.uncertain(robot, {"base.density": 0.2}).lft()
    >>> A, B, C, D = lft.at({"base.density": 1.1})
    >>> lft.parameters, B.shape
    (('base.density',), (18, 9))
    """

    VECTORS: ClassVar = ("repeats", "middle", "half")

    A: Array
    B1: Array
    B2: Array
    C1: Array
    D11: Array
    D12: Array
    C2: Array
    D21: Array
    D22: Array
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    repeats: Array
    middle: Array
    half: Array
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    robot: str

    def __repr__(self) -> str:
        total = int(self.repeats.sum())
        return f"LFT('{self.robot}', nx={len(self.A)}, {len(self.repeats)} parameters, nw={total})"

    def __str__(self) -> str:
        rows = [("parameter", "unit", "least", "largest", "repeated")]
        for name, unit, middle, half, repeats in zip(
            self.parameters, self.units, self.middle, self.half, self.repeats, strict=True
        ):
            ends = f"{middle - half:.6g}", f"{middle + half:.6g}"
            rows.append((name, "." if unit == "1" else unit, *ends, f"{repeats:g}"))
        many, count = counted(len(self.repeats), "parameter"), f"{self.repeats.sum():g}"
        said = f"{self.robot}: {many}, {len(self.A)} states; Delta is {count} x {count}"
        return f"{folded([said])}\n\n{grid(cut(rows), 'll')}"

    @property
    def dt(self) -> float:
        """Sampling time, which is 0 because the model is in continuous time."""
        return 0.0

    def deltas(self, values: Mapping[str, float]) -> Array:
        """Return the deltas (k,) for parameter values {parameter or pattern: value}.

        The delta of every other parameter is 0.
        """
        found = np.zeros(len(self.parameters))
        for key, value in numbers("values", values, "parameter", "value").items():
            for at in matching("parameter", key, self.parameters):
                found[at] = (value - self.middle[at]) / self.half[at]
        return found

    def at(self, values: Mapping[str, float] | Array) -> tuple[Array, Array, Array, Array]:
        r"""Return A, B, C and D at given values of the parameters.

        Parameters
        ----------
        values : mapping or array_like (.., k)
            Values {parameter: value}, or rows of k deltas. Parameters that are not named are at the
            middle of their ranges.

        Returns
        -------
        A, B, C, D : ndarray
            Matrices of the model for each row. For example, the state matrix is
            :math:`A + B_1 \Delta (E - D_{11} \Delta)^{-1} C_1`, with the identity E.

        Raises
        ------
        InputError
            If a row does not have k finite deltas, or the inertia matrix M is singular at these
            values.
        """
        if isinstance(values, Mapping):
            values = self.deltas(values)
        rows = as_double("values", values)
        if not np.isfinite(rows).all() or rows.shape[-1:] != self.repeats.shape:
            raise InputError(
                f"deltas have shape {rows.shape}, expected (.., {len(self.repeats)}) finite numbers"
            )
        delta = np.repeat(rows, self.repeats.astype(int), axis=-1)
        within = np.eye(len(self.D11)) - self.D11 * delta[..., None, :]
        given = np.concatenate((self.C1, self.D12), axis=1)
        try:
            by = delta[..., None] * np.linalg.solve(
                within, np.broadcast_to(given, (*delta.shape, given.shape[1]))
            )
        except np.linalg.LinAlgError:
            raise InputError(
                "the inertia M is singular at these parameters; give narrower ranges"
            ) from None
        nx = len(self.A)
        return (
            self.A + self.B1 @ by[..., :nx],
            self.B2 + self.B1 @ by[..., nx:],
            self.C2 + self.D21 @ by[..., :nx],
            self.D22 + self.D21 @ by[..., nx:],
        )

    def to_control(self) -> control.StateSpace:
        """Return a `control.StateSpace` from (w, u) to (z, y), with signal names.

        The channels of w and z have names such as ``w_PARAMETER_1`` and ``z_PARAMETER_1``. Dots in
        all signal names are replaced by underscores.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        """
        channels = [
            f"{name}.{at + 1}"
            for name, repeats in zip(self.parameters, self.repeats, strict=True)
            for at in range(int(repeats))
        ]
        B, C = np.hstack((self.B1, self.B2)), np.vstack((self.C1, self.C2))
        D = np.block([[self.D11, self.D12], [self.D21, self.D22]])
        inputs = [*(f"w.{name}" for name in channels), *self.input_names]
        outputs = [*(f"z.{name}" for name in channels), *self.output_names]
        return state_space((self.A, B, C, D), 0.0, self.state_names, inputs, outputs)
