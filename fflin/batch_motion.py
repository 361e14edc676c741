"""Accelerations and their slopes at many points, by the compiled kernel."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from fflin.actuation import Actuation
from fflin.batch_tree import LANES, Tree, batch_tree
from fflin.frames import ROOT
from fflin.model import Robot
from fflin.state import StateMap
from fflin.validation import Array


class Layout(NamedTuple):
    """Where the parts of the kernel's work space begin, beyond those of the tree; its size."""

    motion: int
    load: int
    bias: int
    c: int
    columns: int
    slopes: int
    lower: int
    size: int


class Loads(NamedTuple):
    """What acts on the bodies and joints of a robot.

    Attributes
    ----------
    body, wrench, input : ndarray (k,), (k, 6), (k,)
        Of every input that is carried: its body, the moment and force of a unit about the joint's
        origin, in the body's axes, and its number.
    stored_body, stored : ndarray (s,), (s, 3)
        Angular momentum that bodies store, in their axes.
    stiffness, damping : ndarray (n,)
    """

    body: Any
    wrench: Any
    input: Any
    stored_body: Any
    stored: Any
    stiffness: Any
    damping: Any
