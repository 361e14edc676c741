"""The peers, each loaded by its own convention and held against fflin before it is timed."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import fflin
from benchmarks.robots import Array, Point

# In the order of the columns.
MODULES = ("pinocchio_peer", "mujoco_peer", "crocoddyl_peer", "drake_peer", "adam_peer")


@dataclass(frozen=True)
class Method:
    """One way of a peer to the linear model.

    Attributes
    ----------
    name : str
        Column of the table.
    call : callable
        What is timed: from the configuration (velocity, input) to the figures.
    slopes : callable
        Of the last call: the slopes of the accelerations (6 + n, k) in state order, in `frame`:
        over u alone (k = 6 + n), or over the base's turn and place, q_m, nu and u (k = 18 + 3n).
    frame : str
        What the slopes stand in, of `fflin.StateMap`.
    tolerance : float
        Relative to the largest slope of a row of A or of B; differences have half the digits.
    """

    name: str
    call: Callable[[], object]
    slopes: Callable[[], Array]
    frame: str = "hybrid"
    tolerance: float = 1e-8


class WrongResultError(Exception):
    """A peer's result is not fflin's: there is nothing to compare."""


def methods(
    what: str, point: Point, left_out: tuple[str, ...] = ()
) -> tuple[list[Method], list[str]]:
    """Return every peer's checked methods for a case, and what was left out and why.

    Parameters
    ----------
    what : {"at_rest", "at_point"}
        Function of the peers' modules.
    point : Point
    left_out : tuple of str
        Names of methods or of whole peers that are too slow for the case.
    """
    found: list[Method] = []
    notes: list[str] = []
    for module_name in MODULES:
        name = module_name.removesuffix("_peer")
        if name in left_out:
            notes.append(f"{name}: left out on {point.robot.name}, too slow")
            continue
        try:
            module = importlib.import_module(f"benchmarks.peers.{module_name}")
        except ImportError as error:
            notes.append(f"{name}: not installed ({error})")
            continue
        try:
            offered = getattr(module, what)(point)
        except module.REFUSALS as error:
            text = " ".join(str(error).split())
            notes.append(f"{name}: cannot load {point.robot.name}: {text[:80]}")
            continue
        for method in offered:
            if method.name in left_out:
                notes.append(f"{method.name}: left out on {point.robot.name}, too slow")
                continue
            check(method, point, at_rest=what == "at_rest")
            found.append(method)
    return found, notes


def check(method: Method, point: Point, *, at_rest: bool) -> float:
    """Return the largest difference of a peer's slopes to fflin's, relative, or raise."""
    robot, nv = point.robot, 6 + point.robot.n
    motion = () if at_rest else (point.v, point.u)
    lin = fflin.linearize(robot, point.q, *motion, frame=method.frame)
    expected = np.hstack((lin.A[nv:], lin.B[nv:]))
    expected[:, :3] /= 2.0  # q_b is half the turn
    method.call()
    slopes = method.slopes()
    expected = expected[:, -slopes.shape[1] :]
    errors = []
    for columns in (slice(0, -nv), slice(-nv, None)):  # of A and of B
        block = expected[:, columns]
        if block.size:
            scale = np.abs(block).max(axis=1)
            # of rows that are zero in truth
            scale = np.maximum(scale, 1e-3 * scale.max() or 1.0)
            difference = np.abs(slopes[:, columns] - block).max(axis=1)
            errors.append(float((difference / scale).max()))
    worst = max(errors) if np.isfinite(slopes).all() else np.inf
    if not worst < method.tolerance:
        raise WrongResultError(
            f"{method.name} on {robot.name}: differs from fflin by {worst:.1e}"
        )
    return worst
