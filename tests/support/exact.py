"""Controllability in exact arithmetic: rationals, modulo a prime.

A float is a rational number, so that M, K, D and S of a model can be taken as they stand. A rank
modulo the prime is at most the rational one, and less only where the prime divides a minor:
about one case in 10^8.
"""

from fractions import Fraction

import numpy as np

PRIME = 2**31 - 1


def modular(matrix):
    """A matrix of floats or integers modulo the prime."""

    def residue(value):
        exact = Fraction(float(value))
        return exact.numerator * pow(exact.denominator, -1, PRIME) % PRIME

    matrix = np.asarray(matrix)
    return np.array([residue(x) for x in matrix.ravel()], dtype=np.int64).reshape(
        matrix.shape
    )


def product(a, b):
    """The product of a matrix and a vector or matrix modulo the prime."""
    terms = a[:, :, None] * b.reshape(len(b), -1)[None] % PRIME
    return (terms.sum(axis=1) % PRIME).reshape(len(a), *b.shape[1:])


def solve(a, b):
    """a^-1 b modulo the prime, by Gauss and Jordan."""
    size = len(a)
    work = np.hstack((a, b)) % PRIME
    for i in range(size):
        pivot = i + int(np.flatnonzero(work[i:, i])[0])
        work[[i, pivot]] = work[[pivot, i]]
        work[i] = work[i] * pow(int(work[i, i]), -1, PRIME) % PRIME
        others = np.arange(size) != i
        work[others] = (work[others] - work[others, i, None] * work[i] % PRIME) % PRIME
    return work[:, size:]


def krylov_dimension(A, B):
    """Dimension of the smallest A-invariant subspace that holds B, modulo the prime."""
    basis, pivots = np.zeros((0, len(A)), dtype=np.int64), []
    waiting = list(B.T)
    while waiting:
        vector = waiting.pop() % PRIME
        vector = (vector - (vector[pivots, None] * basis % PRIME).sum(axis=0)) % PRIME
        where = np.flatnonzero(vector)
        if not len(where):
            continue
        vector = vector * pow(int(vector[where[0]]), -1, PRIME) % PRIME
        basis = (basis - basis[:, where[0], None] * vector % PRIME) % PRIME
        basis, pivots = np.vstack((basis, vector)), [*pivots, int(where[0])]
        waiting.append(product(A, vector))
    return len(pivots)


def dimension(M, K, D, S):
    """Dimension of what S drives in M a + D v + K q = S u."""
    size = len(M)
    M, K, D, S = map(modular, (M, K, D, S))
    forces = solve(M, np.hstack((-K, -D, S)))
    A = np.zeros((2 * size, 2 * size), dtype=np.int64)
    A[:size, size:] = np.eye(size, dtype=np.int64)
    A[size:] = forces[:, : 2 * size]
    B = np.vstack((np.zeros_like(S), forces[:, 2 * size :]))
    return krylov_dimension(A, B)


def observable(M, K, D, C):
    """Dimension of what C (ny, 2 nv) shows of M a + D v + K q = 0."""
    size = len(M)
    forces = solve(modular(M), np.hstack((-modular(K), -modular(D))))
    A = np.zeros((2 * size, 2 * size), dtype=np.int64)
    A[:size, size:] = np.eye(size, dtype=np.int64)
    A[size:] = forces
    return krylov_dimension(A.T.copy(), modular(C).T.copy())


def rank(matrix):
    """Rank modulo the prime."""
    return krylov_dimension(
        np.zeros((len(matrix), len(matrix)), dtype=np.int64), modular(matrix)
    )
