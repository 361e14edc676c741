"""Figures of the validity of a linear model, and of a funnel."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from fflin.analysis.displacement import shown
from fflin.base.errors import InputError
from fflin.base.figures import COLORS, drawing
from fflin.campaign.reach import Funnel
from fflin.campaign.validity import TRUSTED, Validity

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def plot_validity(validity: Validity, path: str | Path | None = None) -> Figure:
    """Draw the prediction error of a linear model, and the numbers of runs that settled.

    Parameters
    ----------
    validity : Validity
        Result of `fflin.validity`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. Errors as in `plot_motion`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> lin = fflin.linearize(robot)
    >>> reach = fflin.validity(robot, lin, fflin.lqr(lin), samples=4)
    >>> figure = fflin.plot_validity(reach, "validity.png")
    """
    if not isinstance(validity, Validity):
        raise InputError(
            f"validity is a {type(validity).__name__}, expected a Validity, as fflin.validity "
            "returns it"
        )
    percent = 100.0
    with drawing(path, 9.0, 4.3) as figure:
        left, right = figure.subplots(1, 2)
        measured = np.isfinite(validity.prediction_error)
        levels, errors = (each[measured] for each in (validity.levels, validity.prediction_error))
        # Drawn is the error relative to the displacement, of an order less than the error's own.
        order = "relative error"
        if np.isfinite(validity.slope):
            order += f", ~ displacement^{validity.slope - 1.0:.2f}"
        left.loglog(percent * levels, percent * errors, "o-", color=COLORS[0], ms=3, label=order)
        trust = f"accepted error: {percent * TRUSTED:g} %"
        left.axhline(percent * TRUSTED, color="#888888", lw=0.8, label=trust)
        left.set_xticks(percent * validity.levels, [f"{percent * x:.3g}" for x in validity.levels])
        left.minorticks_off()
        left.set(
            title="prediction error of the linear loop",
            xlabel="displacement [% of the largest]",
            ylabel="error [% of the displacement]",
        )

        settled = np.array([outcome == "settled" for outcome in validity.outcomes])
        edges = np.linspace(0.0, 1.0, 11)
        counts = [np.histogram(validity.sampled[at], edges)[0] for at in (settled, ~settled)]
        middles, wide = percent * (edges[1:] + edges[:-1]) / 2.0, percent * 0.09
        right.bar(middles, counts[0], wide, color=COLORS[2], label="settled")
        right.bar(middles, counts[1], wide, bottom=counts[0], color=COLORS[1], label="not settled")
        low, high = validity.rate
        right.set(
            title=f"{validity.settled} of {len(settled)} runs settled",
            xlabel="displacement [% of the largest]",
            ylabel="runs",
        )
        right.yaxis.get_major_locator().set_params(integer=True)
        right.set_ylim(0.0, 1.05 * float(np.add(*counts).max()))
        figure.legend(loc="outside lower center", ncols=4)
        figure.suptitle(
            f"{validity.robot}, up to {shown(validity.largest, validity.joint_unit)}; "
            f"{percent * low:.1f} to {percent * high:.1f} % of displacements settle "
            f"({percent * validity.confidence:g} % confidence)",
            fontsize=10,
        )
    return figure


def plot_funnel(funnel: Funnel, path: str | Path | None = None) -> Figure:
    """Draw the half-axes of a funnel at each knot, and the success rates of the runs from there.

    Parameters
    ----------
    funnel : Funnel
        Result of `fflin.funnel`.
    path : str or Path, optional
        File to save to: .png, .pdf or .svg. Errors as in `plot_motion`.

    Examples
    --------
    >>> robot = fflin.load("planar_detumble")
    >>> v0 = fflin.velocity(robot, {"joint_1": 0.1})
    >>> motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    >>> along = fflin.linearize_trajectory(robot, motion.trajectory())
    >>> reach = fflin.funnel(robot, fflin.tvlqr(along), {"attitude": 5.0}, samples=4, knots=2)
    >>> figure = fflin.plot_funnel(reach, "funnel.png")
    """
    if not isinstance(funnel, Funnel):
        said = f"funnel is a {type(funnel).__name__}, expected a Funnel"
        raise InputError(f"{said}, as fflin.funnel returns it")
    t, percent = funnel.t, 100.0
    reach = {
        "attitude [deg]": funnel.attitude,
        "position [m]": funnel.position,
        "joints [rad|m]": funnel.joints,
    }
    reach = {name: axes for name, axes in reach.items() if axes.any()}
    with drawing(path, 9.0, 1.6 + 1.5 * (len(reach) + 1)) as figure:
        axes = figure.subplots(len(reach) + 1, sharex=True)
        for ax, (name, half), color in zip(axes, reach.items(), COLORS, strict=False):
            for row in half.T:
                ax.plot(t, row, "o-", color=color, ms=3, lw=0.7)
            ax.fill_between(t, half.max(axis=1), color=color, alpha=0.15)
            ax.set(ylabel=name, ylim=(0.0, None))
        low, high = percent * funnel.rate.T
        axes[-1].fill_between(t, low, high, color="#888888", alpha=0.3, label="all starts tried")
        inside = percent * funnel.inside_rate
        axes[-1].plot(t, inside, "o-", color="#000000", ms=3, label="starts inside, lower bound")
        axes[-1].set(xlabel="t [s]", ylabel="success rate [%]", ylim=(0.0, 102.0))
        figure.legend(loc="outside lower center", ncols=2)
        figure.suptitle(
            f"{funnel.robot.name}: errors from which every run ends with {funnel.goal}\n"
            f"half-axes; {percent * funnel.confidence:g} % confidence",
            fontsize=10,
        )
    return figure
