"""Output-feedback compensator with its report."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fflin.base import html
from fflin.base.tables import folded
from fflin.base.validation import Array, Poles, Vector
from fflin.control.estimator import EstimatingDesign, added_notes, time_of
from fflin.control.gain import (
    folded_poles,
    poles_figure,
    summary_of_poles,
    table_of_poles,
)
from fflin.linear.model import ControlSystem, state_space


@dataclass(frozen=True, eq=False, repr=False)
class Compensator(EstimatingDesign):
    r"""Output-feedback compensator ``d(z)/dt = A z + B (y - y0)``, ``u - u0 = C z``.

    For a sampled model, ``A z + B (y - y0)`` is the value of z at the next sample. The state z is
    the estimate of x - x0, followed by the estimated disturbances and biases, if any.

    Attributes
    ----------
    A : ndarray (nz, nz)
    B : ndarray (nz, ny)
    C : ndarray (nu, nz)
    poles : ndarray (2 nz,) of complex
        Closed-loop poles of the model with the compensator: the poles of the gain and of the
        estimator.
    y0, u0 : ndarray
        Outputs and inputs at the operating point.
    E : ndarray (nz, nu)
        Gain of the anti-windup: ``E (u_applied - u)`` is added to dz/dt, or to the next z of a
        sampled compensator, if limits change the command. Zero without integral action, estimated
        disturbances and delayed inputs.
    dt : float
        Sample time [s]; 0 for continuous time.
    state_names, input_names, output_names : tuple of str
        Signals of the compensator. The inputs of the compensator are the outputs of the model.
    robot, urdf_sha256 : str
        Name of the robot, and SHA-256 of its URDF.
    delay : ndarray (nu,)
        Delay of the inputs [s] in the model, see `LinearModel.discretize`; zero without a delay.
    slow_bias : str
        Note on an estimated bias that settles more than ten times slower than the loop, or empty.
    pace : str
        Note on the disk margin of the loop, if default weights were made slower for it, or empty.

    Examples
    --------
    >>> lin = fflin.linearize(fflin.load("planar_detumble"))
    >>> compensator = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4))
    >>> compensator.A.shape, bool(compensator.poles.real.max() < 0)
    ((18, 18), True)
    """

    _SHAPES = "A:zz B:zy C:uz y0:y u0:u input_names:y output_names:u"

    C: Array
    poles: Poles
    y0: Vector
    u0: Vector
    output_names: tuple[str, ...]
    # Files of earlier versions do not contain E.
    E: Array = field(default_factory=lambda: np.zeros((0, 0)))
    # Files of earlier versions contain no delay.
    delay: Vector = field(default_factory=lambda: np.zeros(0))
    slow_bias: str = ""
    pace: str = ""

    def _report(self) -> str:
        """Return the report with the sizes and the poles of the closed loop."""
        poles = table_of_poles(self, "the closed loop")
        title = folded([summary_of_poles(self), self._head()])
        parts = [title, poles]
        if notes := self._notes():
            parts.append(folded(notes))
        return "\n\n".join(parts)

    def _html_parts(self) -> list[str]:
        return [
            html.paragraph(summary_of_poles(self)),
            html.paragraph(self._head()),
            poles_figure(self, "the closed loop"),
            folded_poles(self, "the closed loop"),
            *(html.paragraph(note) for note in self._notes()),
        ]

    def _notes(self) -> list[str]:
        """Return notes on estimated disturbances and biases."""
        notes = list(added_notes(self.state_names))
        if self.slow_bias:
            notes.append(self.slow_bias)
        if self.pace:
            notes.append(self.pace)
        return notes

    def _head(self) -> str:
        nu, nz = self.C.shape
        return (
            f"{self.robot}: compensator with {nz} states, from {len(self.input_names)} outputs of "
            f"the robot to {nu} inputs, {time_of(self.dt)}"
        )

    def to_control(self) -> ControlSystem:
        """Return a `control.StateSpace` from y - y0 to u - u0, with signal names.

        Raises
        ------
        MissingPackageError
            If python-control is not installed.
        InputError
            If two signals differ only by a dot or an underscore, because python-control has no dots
            in names.
        """
        names = self.state_names, self.input_names, self.output_names
        return state_space((self.A, self.B, self.C, 0.0), self.dt, *names)
