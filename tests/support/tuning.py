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


def of_sweep(policy, matrices, frequencies):
    """Gains of the loop from (torque, error of q_b) to (q_b, command), (n, 2, 2, 3, 3)."""
    A, B, C, _ = matrices
    law = policy.system
    n, nz, nu, ny = len(A), len(law.A), B.shape[1], 3
    loop = np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])
    noise = np.vstack((B @ law.D[:, :ny], law.B[:, :ny]))
    drive = np.hstack((np.vstack((B, np.zeros((nz, nu)))), noise))
    read = np.block([[C[:ny], np.zeros((ny, nz))], [law.D @ C, law.C]])
    through = np.zeros((ny + nu, nu + ny))
    through[ny:, nu:] = law.D[:, :ny]
    # The torque does not move the position of the base, whose poles are at zero.
    kept = np.abs(drive).sum(axis=1) > 0.0
    for _ in range(n):
        kept |= (np.abs(loop[:, kept]) > 1e-12 * np.abs(loop).max()).any(axis=1)
    loop, drive, read = loop[np.ix_(kept, kept)], drive[kept], read[:, kept]
    inner = 1j * frequencies[:, None, None] * np.eye(len(loop)) - loop
    responses = read @ np.linalg.solve(inner, drive.astype(complex)) + through
    blocks = responses.reshape(-1, 2, 3, 2, 3).transpose(0, 1, 3, 2, 4)
    return np.linalg.norm(blocks, 2, axis=(3, 4))
