"""Steady-state Kalman filter with its report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fflin.base import html, svg
from fflin.base.errors import listed
from fflin.base.tables import folded
from fflin.base.validation import Array, Poles, Vector
from fflin.control.gain import (
    ModelDesign,
    folded_poles,
    poles_figure,
    summary_of_poles,
    table_of_poles,
)
from fflin.linear.model import ControlSystem, state_space

# Prefixes of the names of states that are estimated disturbances and biases.
DISTURBANCE, BIAS = "disturbance.", "bias."


@dataclass(frozen=True, eq=False, repr=False)
class EstimatingDesign(ModelDesign):
    """Design whose states may contain estimates of disturbances and biases."""

    @property
    def disturbances(self) -> tuple[str, ...]:
        """Names of the states that are estimated disturbances."""
        return names_of(DISTURBANCE, self.state_names)

    @property
    def biases(self) -> tuple[str, ...]:
        """Names of the states that are estimated biases of outputs."""
        return names_of(BIAS, self.state_names)


@dataclass(frozen=True, eq=False, repr=False)
class Estimator(EstimatingDesign):
    r"""Steady-state Kalman filter for the deviations of the state from the operating point.

    With u and y as deviations from u0 and y0, the estimate xh of x - x0 follows
    ``d(xh)/dt = A xh + B u + L (y - C xh - D u)``. For a sampled model, the right side is the
    prediction of xh for the next sample. The filtered estimate, which also uses the present
    measurement, is ``xh + L_update (y - C xh - D u)``.

    Attributes
    ----------
    L : ndarray (nx, ny)
        Filter gain.
    L_update : ndarray (nx, ny)
        Gain of the measurement update. For a sampled model, ``L = A L_update``. In continuous time,
        `L_update` equals `L`.
    P : ndarray (nx, nx)
        Covariance of the estimation error.
    poles : ndarray (nz,) of complex
        Eigenvalues of ``A - L C`` over the estimated states: [1/s] for a continuous model,
        discrete-time poles z for a sampled one.
    residual : float
        Residual of the Riccati equation, relative to the sum of the norms of its terms.
    margin : float
        Distance of the poles from the stability boundary, as in `Gain`.
    A, B, C, D : ndarray
        Matrices of the model. The estimated disturbances and biases are states of this model, and
        follow the states of the robot.
    W, V : ndarray
        Covariances of the state disturbance and of the measurement noise.
    x0, u0, y0 : ndarray
        State, inputs and outputs at the operating point.
    dt : float
        Sample time [s]; 0 for continuous time.
    state_names, input_names, output_names : tuple of str
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    estimated : tuple of str (nz,)
        Names of the estimated states; empty if all states are estimated. The entries of L, P and W
        are zero for states that are not estimated.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> estimator = fflin.kalman(lin, 1e-3, 1e-4)
    >>> bool(estimator.poles.real.max() < 0), estimator.residual < 1e-9
    (True, True)
    """

    _SHAPES = "A:xx B:xu C:yx D:yu L:xy P:xx W:xx V:yy x0:x u0:u y0:y state_names:x output_names:y"

    L: Array
    L_update: Array
    P: Array
    poles: Poles
    residual: float
    margin: float
    C: Array
    D: Array
    W: Array
    V: Array
    x0: Vector
    u0: Vector
    y0: Vector
    output_names: tuple[str, ...]
    estimated: tuple[str, ...]

    def _report(self) -> str:
        """Return the report with the poles and the states that are not estimated."""
        parts = [folded([summary_of_poles(self), self._head()])]
        parts.append(table_of_poles(self, "A - L C"))
        parts.append(f"Riccati residual {self.residual:.1e}")
        if extended := added_notes(self.state_names):
            parts.append(folded(extended))
        if left := self._not_estimated():
            parts.append(folded([left]))
        return "\n\n".join(parts)

    def _html_parts(self) -> list[str]:
        states = svg.Axis(self.state_names, [""] * len(self.state_names))
        outputs = svg.Axis(self.output_names, [""] * len(self.output_names))
        L = svg.heat_map("L", self.L, states, outputs)
        return [
            html.verdict(summary_of_poles(self), self.margin > 0.0),
            html.paragraph(self._head()),
            html.paragraph(f"Riccati residual {self.residual:.1e}"),
            *(html.paragraph(note) for note in added_notes(self.state_names)),
            html.side_by_side(poles_figure(self, "A - L C"), L),
            folded_poles(self, "A - L C"),
            html.paragraph(self._not_estimated(), "note"),
        ]

    def _head(self) -> str:
        count = len(self.estimated or self.state_names)
        return (
            f"{self.robot}: estimator of {count} states from {len(self.output_names)} outputs, "
            f"{time_of(self.dt)}"
        )

    def _not_estimated(self) -> str:
        left = [
            name
            for name in self.state_names
            if self.estimated and name not in self.estimated
        ]
        if not left:
            return ""
        return (
            f"not estimated: {listed(left)}, which have no effect on the other states"
        )

    def to_control(self) -> ControlSystem:
        """Return a `control.StateSpace` from u - u0 and y - y0 to xh, with signal names.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        """
        L = self.L
        both = (*self.input_names, *self.output_names)
        system = (
            self.A - L @ self.C,
            np.hstack((self.B - L @ self.D, L)),
            np.eye(len(L)),
            0.0,
        )
        return state_space(system, self.dt, self.state_names, both, self.state_names)


def names_of(prefix: str, names: Sequence[str]) -> tuple[str, ...]:
    """Return the names that begin with a prefix."""
    return tuple(name for name in names if name.startswith(prefix))


def added_notes(names: Sequence[str]) -> list[str]:
    """Return lines that state which states are disturbances, and which are biases."""
    notes = []
    for title, prefix in (("disturbances", DISTURBANCE), ("biases", BIAS)):
        members = [name.removeprefix(prefix) for name in names_of(prefix, names)]
        if members:
            notes.append(f"estimated {title}: {', '.join(members)}")
    return notes


def time_of(dt: float) -> str:
    """Return the words of a report for a sample time [s]; 0 is continuous time."""
    if dt:
        return f"sampled at {dt:g} s"
    return "continuous"
