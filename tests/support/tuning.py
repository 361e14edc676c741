"""Generalised plants for tests of tuning: problems of matrices without a robot."""

import numpy as np
import scipy.linalg

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
    """Gains (n, 2) of the loop: from a torque to q_b, and from an error of q_b to the command."""
    A, B, C, _ = matrices
    law = policy.system
    n, nz, nu, ny = len(A), len(law.A), B.shape[1], 3
    loop = np.block([[A + B @ law.D @ C, B @ law.C], [law.B @ C, law.A]])
    noise = np.vstack((B @ law.D[:, :ny], law.B[:, :ny]))
    drive = np.hstack((np.vstack((B, np.zeros((nz, nu)))), noise))
    read = np.block([[C[:ny], np.zeros((ny, nz))], [law.D @ C, law.C]])
    # The torque does not move the position of the base, whose poles are at zero.
    kept = np.abs(drive).sum(axis=1) > 0.0
    for _ in range(n):
        kept |= (np.abs(loop[:, kept]) > 1e-12 * np.abs(loop).max()).any(axis=1)
    loop, drive, read = loop[np.ix_(kept, kept)], drive[kept], read[:, kept]
    responses = responses_of(loop, drive, read, 1j * frequencies)
    pointing = responses[:, :ny, :nu]
    command = responses[:, ny:, nu:] + law.D[:, :ny]
    return np.linalg.norm(np.stack((pointing, command), axis=1), 2, axis=(2, 3))


def responses_of(A, B, C, points):
    """Frequency responses C (s I - A)^-1 B (n, ny, nu) at the points s (n,) of the plane.

    With the Schur form of A, each point takes a back substitution instead of a decomposition.
    """
    T, Z = scipy.linalg.schur(A, output="complex")
    drive = Z.conj().T @ B
    states = np.empty((len(A), len(points), B.shape[1]), complex)
    for row in range(len(A) - 1, -1, -1):
        above = np.tensordot(T[row, row + 1 :], states[row + 1 :], 1)
        states[row] = (drive[row] + above) / (points - T[row, row])[:, None]
    return np.einsum("yi,ipu->pyu", C @ Z, states, optimize=True)
