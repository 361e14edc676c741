"""A state feedback with the figures that prove it, and how it is shown."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from fflin.analysis.wheels import picked
from fflin.base.record import NOT_VERIFIED, Design
from fflin.base.tables import grid, matrix, width
from fflin.base.validation import Array
from fflin.control.margins import Margins, input_margins
from fflin.linear.model import LinearModel

if TYPE_CHECKING:
    from fflin.control.riccati import Solution

# A larger gain, of more than three joints, is shown by the norms of its blocks.
_LARGE = 9 * 18

# A disk margin below which a loop is called fragile.
_FRAGILE = 0.3


@dataclass(frozen=True, eq=False, repr=False)
class Gain(Design):
    r"""A state feedback ``u = u0 - K (x - x0)`` with the figures that prove it.

    Attributes
    ----------
    K : ndarray (nu, nx)
    P : ndarray (nx, nx)
        The cost from x on is ``(x - x0)' P (x - x0)``.
    poles : ndarray (nz,) of complex
        Eigenvalues of ``A - B K`` [1/s] over what is regulated; of a sampled model of the step.
    residual : float
        Of the Riccati equation: its norm relative to the sum of the norms of its terms.
    margin : float
        Distance of the poles to the boundary of stability: the slowest decay [1/s]; of a sampled
        model 1 less the largest modulus.
    method : str
        "structured" (half-size), "general" (SciPy) or "closed form".
    A, B, Q, R, N : ndarray
        The model and the weights on deviations; N is zero where there was none.
    x0 : ndarray (nx,)
    u0 : ndarray (nu,)
    dt : float
        Sampling time [s]; 0 for continuous time.
    state_names, input_names, state_units, input_units : tuple of str
    frame, robot : str
        Of the model.
    weights : str
        The rule that made the weights, in words.
    regulated : tuple of str (nz,)
        The states that are fed back, all where it is empty; K, P, Q and N are zero elsewhere.
    """

    VECTORS: ClassVar = ("poles", "x0", "u0")

    K: Array
    P: Array
    poles: Any
    residual: float
    margin: float
    method: str
    A: Array
    B: Array
    Q: Array
    R: Array
    N: Array
    x0: Array
    u0: Array
    dt: float
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    state_units: tuple[str, ...]
    input_units: tuple[str, ...]
    frame: str
    robot: str
    weights: str = field(default_factory=str)
    regulated: tuple[str, ...] = field(default_factory=tuple)

    def __repr__(self) -> str:
        nu, nx = self.K.shape
        time = f"dt={self.dt:g} s" if self.dt else "continuous"
        return (
            f"Gain('{self.robot}', nx={nx}, nu={nu}, {time}, margin={self.margin:.3g}, "
            f"residual={self.residual:.1e})"
        )

    def __str__(self) -> str:
        """Show the gain, its poles, and the figures that prove it."""
        nu, nx = self.K.shape
        time = f"sampled at {self.dt:g} s" if self.dt else "continuous"
        head = f"{self.robot}: u = u0 - K (x - x0), {nx} states, {nu} inputs"
        head = textwrap.fill(f"{head}, frame {self.frame}, {time}", width())
        if self.K.size <= _LARGE:
            body = f"K ({nu} x {nx})\n\n{matrix(self.K, self.input_names, self.state_names)}"
        else:
            body = (
                f"K ({nu} x {nx}): norms of its blocks; a file holds all of it\n\n{_blocks(self)}"
            )
        figures = textwrap.fill(_figures(self), width())
        parts = [head, body, _poles(self), figures]
        if left := _unregulated(self):
            parts.append(textwrap.fill(f"not regulated: {left}", width()))
        if self.weights:
            parts.append(textwrap.fill(f"weights: {self.weights}", width()))
        if fragile := fragility(self):
            parts.append(textwrap.fill(f"warning: {fragile}", width()))
        return "\n\n".join(parts if self.verified else [*parts, NOT_VERIFIED])

    @property
    def closed_loop(self) -> Array:
        """A - B K (nx, nx)."""
        loop: Array = self.A - self.B @ self.K
        return loop

    @cached_property
    def margins(self) -> Margins:
        """Gain and phase margins at the inputs, computed when first asked for."""
        S = picked(self.regulated or self.state_names, self.state_names)
        return input_margins(S @ self.A @ S.T, S @ self.B, self.K @ S.T, self.R, self.dt)


def make_gain(
    lin: LinearModel,
    solution: Solution,
    Q: Array,
    R: Array,
    N: Array | None,
    weights: str = "as given",
) -> Gain:
    """Return a gain of a solution (P, K, poles, residual, method)."""
    poles, margin = solution.ordered(lin.dt)
    return Gain(
        **{key: getattr(solution, key) for key in ("K", "P", "residual", "method")},
        **{key: getattr(lin, key) for key in _FROM_MODEL},
        poles=poles,
        margin=margin,
        Q=Q,
        R=R,
        N=np.zeros(lin.B.shape) if N is None else N,
        weights=weights,
        regulated=lin.state_names,
        verified=lin.verified,
    )


def for_whole(gain: Gain, lin: LinearModel) -> Gain:
    """Return a gain of a part of a model as one of the model, with the rest not fed back."""
    if gain.state_names == lin.state_names:
        return gain
    S = picked(gain.regulated, lin.state_names)
    values = {key: getattr(lin, key) for key in _FROM_MODEL}
    values |= {"K": gain.K @ S, "P": S.T @ gain.P @ S, "Q": S.T @ gain.Q @ S, "N": S.T @ gain.N}
    return replace(gain, **values)


_FROM_MODEL = (
    *("A", "B", "x0", "u0", "dt", "frame", "robot"),
    *("state_names", "input_names", "state_units", "input_units"),
)


def fragility(gain: Gain) -> str:
    """Say what to do about a gain that bears little at its inputs; else nothing."""
    # A continuous optimal loop with a diagonal R has a disk margin of 2/3 at least.
    R = gain.R
    alone = np.count_nonzero(R) == np.count_nonzero(R.diagonal())
    if alone and not gain.dt and not gain.N.any():
        return ""
    margins = gain.margins
    if margins.disk >= _FRAGILE:
        return ""
    remedy = "shorten dt, or slow the loop" if gain.dt else "weigh each input alone"
    return (
        f"the loop bears only {margins.phase:.2g} deg of phase at its inputs (disk margin "
        f"{margins.disk:.2g}, below {_FRAGILE:g}): a small delay or error of the model makes it "
        f"unstable; {remedy}, as the default weights do"
    )


def _unregulated(gain: Gain) -> str:
    """Say which states are not fed back, and why."""
    left = [name for name in gain.state_names if gain.regulated and name not in gain.regulated]
    base = [name for name in left if name.startswith(("r_b.", "v_b."))]
    shown = "r_b, v_b" if len(base) == 6 else ", ".join(base)
    parts = [f"{shown} (no input pushes it)"] if base else []
    if any(name.startswith("q_m.") for name in left):
        parts.append("wheel angles (ignorable)")
    if speeds := [name for name in left if name.startswith("qdot_m.")]:
        B = gain.B / np.linalg.norm(gain.B, axis=1, keepdims=True).clip(1e-300)
        held, both = (
            np.linalg.matrix_rank(picked(names, gain.state_names) @ B)
            for names in (gain.regulated, (*gain.regulated, *speeds))
        )
        tied = "tied to the body's rate by the conserved momentum"
        why = tied if held == both else "wheel_speeds=True regulates those that can be"
        parts.append(f"wheel speeds ({why})")
    return ", ".join(parts)


def _blocks(gain: Gain) -> str:
    rows, columns = _groups(gain.input_names), _groups(gain.state_names)
    values = np.array(
        [[np.linalg.norm(gain.K[np.ix_(i, j)]) for j in columns.values()] for i in rows.values()]
    )
    return matrix(values, list(rows), list(columns))


def _groups(names: Sequence[str]) -> dict[str, list[int]]:
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(name.partition(".")[0], []).append(index)
    return groups


def _poles(gain: Gain) -> str:
    poles: Any = gain.poles[gain.poles.imag >= 0.0]
    if gain.dt:
        order, heads = np.argsort(-np.abs(poles)), ["pole", "modulus", "frequency [rad/s]"]
        rates = np.log(np.where(poles == 0.0, 1e-300, poles)) / gain.dt
        columns = [np.abs(poles), np.abs(rates.imag)]
    else:
        order, heads = np.argsort(-poles.real), ["pole [1/s]", "frequency [rad/s]", "damping"]
        columns = [np.abs(poles), -poles.real / np.abs(poles)]
    body = [
        [_pole(poles[i]), *(f"{column[i]:.4g}" for column in columns)]
        for i in (order if len(order) <= 24 else [*order[:12], *order[-4:]])
    ]
    if len(order) > 24:
        body.insert(12, [f"... {len(order) - 16} more", "", ""])
    title = "poles of A - B K, the slowest first"
    return f"{title}\n\n{grid([heads, *body], 'l')}"


def _pole(pole: complex) -> str:
    return f"{pole.real:.5g}" + (f" +- {pole.imag:.5g}i" if pole.imag else "")


def _figures(gain: Gain) -> str:
    margins = gain.margins
    slowest = "1 - largest modulus" if gain.dt else "slowest decay [1/s]"
    low, high = margins.gain
    return (
        f"Riccati residual {gain.residual:.1e} ({gain.method}); {slowest} {gain.margin:.5g}; "
        f"all inputs at once bear gains of {low:.3g} to {high:.3g} and {margins.phase:.3g} deg of "
        f"phase (disk margin {margins.disk:.3g})"
    )
