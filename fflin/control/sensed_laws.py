"""Sampled laws in series with sensors that have their own sample times and delays."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fflin.base.validation import Array
from fflin.control.loops import Sample
from fflin.control.policy import System
from fflin.control.sensors import SensorTiming, sensor_systems


def sensed(terms: Sequence[Sample], timing: SensorTiming) -> list[Sample]:
    """Return laws that include the sensors, for each sample of a common period.

    `terms` contains the law at each sample of its own period. In the result, y is what the sensors
    see, and the states of the sensors follow the states of the law.
    """
    if timing.is_plain:
        return list(terms)
    count = math.lcm(len(terms), timing.period)
    return [
        _in_series(terms[k % len(terms)], *matrices)
        for k, matrices in zip(range(count), sensor_systems(timing), strict=False)
    ]


def sensed_systems(laws: Sequence[System], timing: SensorTiming) -> list[System]:
    """Return laws that include the sensors, for each sample of a common period; see `sensed`."""
    if timing.is_plain:
        return list(laws)
    nu, ny = laws[0].D.shape
    terms = [Sample(*law[:4], np.zeros(nu), np.zeros(ny)) for law in laws]
    return [
        laws[0]._replace(A=term.A, B=term.B, C=term.C, D=term.D)
        for term in sensed(terms, timing)
    ]


def _in_series(law: Sample, A: Array, B: Array, C: Array, D: Array) -> Sample:
    """Return a law that receives the output of a system with the matrices A, B, C and D."""
    nz, size = len(law.A), len(A)
    E = law.E
    if E.size:
        E = np.vstack((E, np.zeros((size, E.shape[1]))))
    jump = law.jump
    if np.ndim(jump):
        jump = np.append(jump, np.zeros(size))
    return law._replace(
        A=np.block([[law.A, law.B @ C], [np.zeros((size, nz)), A]]),
        B=np.vstack((law.B @ D, B)),
        C=np.hstack((law.C, law.D @ C)),
        D=law.D @ D,
        jump=jump,
        E=E,
    )
