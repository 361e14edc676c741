"""Figure of the loop of a periodic law: its response to all harmonics of a frequency at once."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from fflin.base.figures import Axes, Figure, cycle, drawing, legend_below
from fflin.base.process import in_one_thread
from fflin.base.validation import Array, Values
from fflin.control.loop_margins import Margins
from fflin.control.optimal.periodic_loops import Harmonics, PeriodicLoop
from fflin.control.periodic_closed_loop import PeriodicClosedLoop

_LINE = "#888888"

# Angles below this fraction of the largest angle are not drawn.
_SMALLEST = 1e-5

# Half of the width and height of the part of the complex plane with the eigenloci.
_PLANE = 3.0


class LiftedLoop(NamedTuple):
    """Response of a periodic loop with N samples and n channels to its N harmonics.

    Attributes
    ----------
    w : ndarray (k,)
        Frequencies [rad/s] from 0 to pi/(N dt), which excludes 0.
    loci : ndarray (n, k, N) of complex
        Eigenvalues of the loop gain of each channel, with the loops of all others closed.
    gains : ndarray (n, k)
        Largest singular value of the loop gain of each channel.
    sensitivities : ndarray (n, k)
        Largest singular value of the sensitivity of each channel.
    together : ndarray (2, k)
        Largest singular values of the sensitivity and of the complementary sensitivity of all
        channels.
    """

    w: Array
    loci: Values
    gains: Array
    sensitivities: Array
    together: Array


def lifted_loop(loop: PeriodicLoop, dt: float) -> LiftedLoop:
    """Return the response of a loop from changes of its channels to (S - T)/2."""
    harmonics = Harmonics(loop)
    shown = harmonics.angles > _SMALLEST * harmonics.angles[-1]
    halves = harmonics.responses[shown]
    unit = np.eye(halves.shape[-1])
    # S + T = E
    sensitivity = halves + 0.5 * unit
    together = np.array([_largest(sensitivity), _largest(unit - sensitivity)])
    loci, gains, sensitivities = [], [], []
    for index in range(harmonics.channels):
        part = slice(index, None, harmonics.channels)
        alone = sensitivity[:, part, part]
        gain = np.linalg.inv(alone) - np.eye(harmonics.count)
        loci.append(np.linalg.eigvals(gain))
        gains.append(_largest(gain))
        sensitivities.append(_largest(alone))
    return LiftedLoop(
        harmonics.angles[shown] / dt,
        np.array(loci),
        np.array(gains),
        np.array(sensitivities),
        together,
    )


def _largest(matrices: Values) -> Array:
    """Return the largest singular values (k,) of matrices (k, n, n)."""
    values: Array = np.linalg.norm(matrices, 2, axis=(1, 2))
    return values


def plot_periodic(
    closed: PeriodicClosedLoop, path: str | Path | None, axes: Axes | None
) -> Figure:
    """Draw the loop gain, the eigenloci and the sensitivity of a loop with a periodic law."""
    margins = in_one_thread(closed.margins)()
    loop = closed.periodic(closed.with_delays(closed.delays))
    lifted = in_one_thread(lifted_loop)(loop, closed.dt)
    names = list(closed.names)
    if margins.stable:
        names = [
            f"{one.name}: {one.gain[0]:.2g} to {one.gain[1]:.3g}, delay {one.delay:.2g} s"
            for one in margins.channels
        ]
    with drawing(path, 12.0, 8.5, axes=axes) as figure:
        (sizes, loci), (sensitivity, together) = figure.subplots(2, 2)
        colors = cycle(len(names))
        for panel in (sizes, sensitivity):
            panel.set_prop_cycle(color=colors)
        sizes.loglog(lifted.w, lifted.gains.T, lw=1.0)
        sizes.axhline(1.0, color=_LINE, lw=0.8)
        sizes.set(title="loop gain of each input: largest singular value", ylabel="|L|")
        _draw_loci(loci, lifted.loci, colors)
        _draw_decibels(sensitivity, lifted.w, lifted.sensitivities)
        sensitivity.set(title="sensitivity of each input: largest singular value")
        curves = _draw_decibels(together, lifted.w, lifted.together)
        together.set(title="all inputs at once: largest singular values")
        together.legend(curves, ["sensitivity", "complementary sensitivity"])
        for panel in (sizes, sensitivity, together):
            end = math.pi / closed.dt / len(closed.laws)
            panel.set(xlabel="frequency [rad/s]", xlim=(lifted.w[0], end))
        legend_below(sizes, names, "margins at each input: gain factors, delay")
        figure.suptitle(_title(margins), x=0.02, ha="left")
    return figure


def _draw_loci(panel: Axes, loci: Values, colors: list[str]) -> None:
    """Draw the eigenvalues (n, k, N) of the loop gains near the critical point."""
    for color, values in zip(colors, loci, strict=True):
        panel.plot(values.real, values.imag, ".", color=color, ms=1.5)
    panel.plot(-1.0, 0.0, "+", color=_LINE, ms=10)
    panel.set(
        title="eigenloci of the loop gain of each input",
        xlabel="real part",
        ylabel="imaginary part",
        xlim=(-_PLANE, _PLANE),
        ylim=(-_PLANE, _PLANE),
    )


def _draw_decibels(panel: Axes, w: Array, values: Array) -> list[Any]:
    """Draw the values (n, k) in decibels, and return the curves."""
    curves: list[Any] = panel.semilogx(w, 20.0 * np.log10(values.T), lw=1.0)
    panel.axhline(0.0, color=_LINE, lw=0.8)
    panel.set(ylabel="[dB]")
    return curves


def _title(margins: Margins) -> str:
    time = f", sampled at {margins.dt:g} s with a period of {margins.samples} samples"
    if margins.delay:
        time += f", delay {margins.delay:g} s"
    together = "the loop is unstable"
    if margins.stable:
        low, high = margins.gain
        together = (
            f"margins for simultaneous changes: gain {low:.2g} to {high:.3g} (disk margin "
            f"{margins.disk:.3g})"
        )
    return (
        f"{margins.robot}{time}: response of the loop to all {margins.samples} frequencies of an "
        f"oscillation\n{together}"
    )
