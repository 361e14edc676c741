"""Both sides of `check` on random robots: no false alarm, and no small error is missed."""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

import fflin
from fflin.linear.check import References
from tests.support.random_robots import random_case

# Seeds of the robots of each test: few robots by default, and 205 in all tests.
SEEDS = [range(first, first + 5) for first in range(0, 10, 5)]
SEEDS += [
    pytest.param(range(first, first + 39), marks=pytest.mark.exhaustive)
    for first in range(10, 205, 39)
]


class Sizes:
    """Scales of the entries of a model: the largest of the block and of the terms that cancel."""

    def __init__(self, case, lin):
        self.lin, self.nv = lin, len(lin.M)
        M, nv = lin.M, self.nv
        root = np.sqrt(M.diagonal())
        self.inverse = np.linalg.inv(M / np.outer(root, root)) / np.outer(root, root)
        mobility = np.sqrt(self.inverse.diagonal())
        self.units = np.concatenate((mobility, mobility))
        lower = lin.B[nv:]
        per_input = np.sqrt(np.einsum("ik,ij,jk->k", lower, M, lower))
        self.inputs = 1.0 / np.where(per_input > 0.0, per_input, 1.0)
        forces = np.abs(M @ lin.A[nv:])
        # Gravity and the acceleration of a robot in free fall cancel, and so do the terms with the
        # angular velocity of an orbit. A base rotation turns the weight, and a joint moves it.
        gravity = np.linalg.norm(case.robot.gravity)
        forces[:, :3] += gravity * np.abs(M[:, 3:6]).max(axis=1, keepdims=True)
        moving = np.r_[0:3, 6:nv]
        forces[moving, 6:nv] += gravity * np.abs(M[3:6, 6:]).max(axis=0)
        if case.robot.orbit:
            turning = forces[:, nv : nv + 3].max(axis=1, keepdims=True)
            forces[:, :3] += 2.0 * case.robot.orbit.mean_motion * turning
            # Coriolis terms of the bodies cancel each other. The integral over the mass of the
            # magnitudes of two columns of Jacobians is at most the product of their norms.
            forces[:, nv:] += 2.0 * case.robot.orbit.mean_motion * np.outer(root, root)
        self.terms = {
            "A": np.vstack((np.abs(lin.A[:nv]), np.abs(self.inverse) @ forces)),
            "B": np.vstack(
                (np.abs(lin.B[:nv]), np.abs(self.inverse) @ np.abs(M @ lower))
            ),
        }

    def largest(self, name, matrix, rows, columns, at):
        """The largest entry of a block of a matrix like A, B, C or D, in the units of an entry."""
        row_units = self.units if name in "AB" else np.ones(len(matrix))
        column_units = self.units if name in "AC" else self.inputs
        block = np.abs(matrix[np.ix_(rows, columns)]) * column_units[columns]
        largest = (block / row_units[rows][:, None]).max()
        return largest * row_units[at[0]] / column_units[at[1]]

    def of(self, name, reference, rows, columns, at):
        """The scale of the entry `at` in a block of A, B, C or D."""
        where = name, getattr(self.lin, name), rows, columns, at
        size = self.largest(*where)
        # Some blocks are zero, or only rounding errors. Their scale is the scale of the check.
        if size <= self.largest(name, reference.rounding, *where[2:]):
            return self.largest(name, reference.scales(1e-9), *where[2:])
        # The terms of C are the derivatives of the kinematics and of the accelerations. They cancel
        # for an accelerometer in free fall.
        terms = self.terms.get(name, reference.scale)
        return max(size, terms[at])


def vectors(lin):
    """{output row: the rows of the same vector, such as the three rows of a position}."""
    names = [
        name if name in lin.state_names else name.rpartition(".")[0]
        for name in lin.output_names
    ]
    return {
        row: np.flatnonzero([n == name for n in names])
        for row, name in enumerate(names)
    }


class Entry(NamedTuple):
    """An entry of a matrix, its scale, and the name of its block in the check."""

    at: tuple
    size: float
    block: str


def rounds(case, lin, references, rng):
    """Yield (matrix, entries): one random entry of each block, each block by itself in a round."""
    state, nv, sizes = references.route.state, len(lin.M), Sizes(case, lin)
    exact = references.matrices()
    groups = {
        name: np.arange(state.nx)[part] for name, part in state.groups._asdict().items()
    }
    inputs = {
        name: np.array(part)
        for name, part in references.route.aba.actuation.groups.items()
    }

    def entry(name, rows, columns, block):
        at = rng.choice(rows), rng.choice(columns)
        of_block = of_vector[at[0]] if name in "CD" else rows
        return Entry(at, sizes.of(name, exact[name], of_block, columns, at), block)

    of_vector = vectors(lin)
    for name, parts in (("A", groups), ("B", inputs)):
        yield (
            name,
            [
                entry(name, rows, columns, f"{name}[{row}, {column}]")
                for row, rows in groups.items()
                for column, columns in parts.items()
                if len(rows) and len(columns)
            ],
        )
    if state.robot.outputs == (fflin.FullState(),):
        return
    words = output_words(state)
    halves = {"positions": np.arange(nv), "velocities": np.arange(nv, 2 * nv)}
    for name, parts in (("C", halves), ("D", inputs)):
        for columns in parts.values():
            if len(columns):
                yield (
                    name,
                    [
                        entry(name, rows, columns, f"{name} ({word})")
                        for word, rows in words.items()
                    ],
                )


def output_words(state):
    """{word of an output: its rows}."""
    words, at, n = {}, 0, state.robot.n
    states = {"base": 6, "joints": n, "rates": n}
    for output in state.robot.outputs:
        count = len(output.signals) or states[output.WORD]
        if count:
            words.setdefault(output.WORD, []).extend(range(at, at + count))
        at += count
    return words


@pytest.mark.parametrize("seeds", SEEDS, ids=lambda seeds: f"{seeds[0]}-{seeds[-1]}")
def test_correct_models_are_verified_and_errors_of_1e_6_are_detected(seeds):
    for seed in seeds:
        case = random_case(seed)
        lin = case.linearize()
        references = References(case.robot, lin)
        alarms = [row for row in references.rows(lin) if not row.ok]
        assert not alarms, (seed, alarms)

        rng = np.random.default_rng(seed)
        for name, entries in rounds(case, lin, references, rng):
            wrong = getattr(lin, name).copy()
            for entry in entries:
                wrong[entry.at] += rng.choice((-1e-6, 1e-6)) * entry.size
            rows = references.rows(replace(lin, **{name: wrong}))
            failed = {row.block for row in rows if not row.ok}
            missed = [entry for entry in entries if entry.block not in failed]
            assert not missed, (seed, name, missed)
