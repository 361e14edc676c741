"""Generalised plants for tests of tuning: problems of matrices without a robot."""

import numpy as np

from fflin.base.process import in_one_thread
from fflin.tuning.channels import Channel, Ends
from fflin.tuning.goals import MaxGain
from fflin.tuning.plant import Plant, Signals
from fflin.tuning.problem import Case, Measure, Problem
from fflin.tuning.starts import searched
from fflin.tuning.structures import StaticGain, Structured


def signals_of(A, B, C):
    """Names for the outputs y0, y1, ... and the inputs u0, u1, ... of matrices."""
    outputs = tuple(f"y{index}" for index in range(len(C)))
    inputs = tuple(f"u{index}" for index in range(B.shape[1]))
    return Signals(
        outputs, inputs, ("1",) * len(outputs), ("1",) * len(inputs), A, B, C
    )


def problem_of(matrices, structure=None):
    """The problem of the gain from w to z of a plant (A, B1, B2, C1, C2, D11, D12, D21)."""
    A, B1, B2, C1, C2, D11, D12, D21 = (
        np.atleast_2d(np.array(matrix, float)) for matrix in matrices
    )
    signals = signals_of(A, B2, C2)
    structured = Structured(structure or StaticGain("*", "*"), signals)
    plant = Plant(A, B2, C2, np.zeros((len(C2), B2.shape[1])), len(C2), 0.0)
    ends = Ends((("sensor", 0),), (("output", 0),), np.ones(1), np.ones(1))
    measure = Measure(MaxGain("y0", "y0"), ends)
    case = Case(plant, [measure])
    case.channels = [Channel(plant, B1, C1, D11, D12, D21)]
    return Problem(structured, [measure], [case])


@in_one_thread
def least_gain(matrices, structure=None, starts=3, steps=300, seed=1):
    """The least gain of several starts, and the law that reaches it."""
    problem = problem_of(matrices, structure)
    best, _ = searched(problem, starts, steps, seed)
    return float(np.exp(best.objective)), problem.law(best.x)
