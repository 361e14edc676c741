"""Random decisions about reach, sight and momenta, as JSON, beside exact arithmetic.

``python -m tests.support.decisions --exact`` judges them all; without ``--exact`` the decisions
alone are printed, to be compared between processors.
"""

import argparse
import json
import warnings

import numpy as np

import fflin
from fflin import BaseForce, BaseTorque, JointPositions, JointTorque, JointVelocities
from tests.support import exact
from tests.support.robots import BUNDLED, random_tree

PERIODS = (0.0, 0.01, 0.1)


def case(seed, robots):
    """A robot at rest with random springs, dampers, inputs and outputs, and its K, D, S, C."""
    rng = np.random.default_rng(seed)
    if rng.random() < 0.5:
        robot = robots[str(rng.choice([name for name in BUNDLED if robots[name].n]))]
    else:
        robot = random_tree(rng, int(rng.integers(1, 11)))
    at = {}
    # Stretched out, both ends of the long arm weigh the same: exact arithmetic of an inertia that
    # is rounded does not see it, and it has a test of its own.
    if rng.random() < 0.7 or robot.name == "canadarm2":
        at = {j: rng.uniform(-1.0, 1.0) for j in robot.joint_names}
    equal = rng.random() < 0.3

    def some(share, low, high):
        chosen = rng.random(robot.n) < share
        values = 10.0 ** rng.uniform(low, high, size=robot.n)
        values = np.full(robot.n, round(values[0], 3)) if equal else values
        pairs = zip(robot.joint_names, values, chosen, strict=True)
        return {joint: float(value) for joint, value, on in pairs if on}

    stiffness = some(rng.choice([0.0, 0.3, 0.6, 1.0]), 0.0, 3.0)
    damping = some(rng.choice([0.0, 0.3, 0.6, 1.0]), -1.0, 1.5)
    share = rng.choice([0.3, 0.6, 1.0])
    driven = [j for j in robot.joint_names if rng.random() < share] or list(
        robot.joint_names[:1]
    )
    base = [kind() for kind in (BaseTorque, BaseForce) if rng.random() < 0.25]
    seen = [j for j in robot.joint_names if rng.random() < share] or list(
        robot.joint_names[-1:]
    )
    kind = (JointPositions, JointVelocities)[int(rng.integers(2))]
    chosen = robot.replace(
        inputs=[*base, *(JointTorque(j) for j in driven)],
        outputs=[kind(tuple(seen))],
        stiffness=stiffness,
        damping=damping,
        rest=at,
    )
    lin = fflin.linearize(chosen, fflin.configuration(robot, at))
    K, D = (
        np.diag([0.0] * 6 + [values.get(j, 0.0) for j in robot.joint_names])
        for values in (stiffness, damping)
    )
    return lin, K, D


def decisions(lin):
    """What is decided about a model: numbers and truths alone, with the notes of doubt."""
    reach, sight = fflin.controllability(lin), fflin.observability(lin)
    reduced = fflin.momentum_reduction(lin)
    notes = [*reach.notes, *getattr(sight, "notes", ()), *getattr(reduced, "notes", ())]
    return {
        "controllable": reach.dimension,
        "stabilizable": reach.stabilizable,
        "observable": sight.dimension,
        "detectable": sight.detectable,
        "reduced": len(reduced.A),
        "doubts": [note for note in notes if note.startswith("undecided")],
    }


def truth(lin, K, D):
    """The same decisions by exact arithmetic on M a + D v + K q = S u."""
    # To 38 bits: a robot that is symmetric but for the last bits of its inertia is symmetric, and
    # what these alone couple is not coupled.
    size = 2.0 ** np.round(np.log2(lin.M.diagonal()) / 2.0)
    unit = np.outer(size, size) * 2.0**-38
    M = np.round(lin.M / unit) * unit
    nv = len(M)
    S = np.round(M @ lin.B[nv:])
    none = np.zeros_like(D)
    C = lin.C.copy()

    def settles(pushed):
        """What is neither pushed nor damped, nor held by a spring where it stands, stays."""
        driven = np.hstack((pushed, D))
        rank = exact.rank(np.hstack((K, pushed)))
        return rank == nv and exact.dimension(M, K, none, driven) == 2 * nv

    def seen(damping, rows):
        return exact.observable(M, K, damping, rows)

    observed = seen(D, C)
    at_rest = np.hstack((C[:, :nv], np.zeros_like(C[:, :nv])))
    rigid = exact.rank(np.vstack((K, at_rest[:, :nv]))) == nv
    shown = np.vstack((C, np.hstack((np.zeros((nv, nv)), D))))
    return {
        "controllable": exact.dimension(M, K, D, S),
        "stabilizable": settles(S),
        "observable": observed,
        "detectable": rigid and seen(none, shown) == 2 * nv,
        "reduced": 2 * exact.rank(np.hstack((K, D, S))),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=800)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--exact", action="store_true")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    robots = {name: fflin.load(name) for name in BUNDLED}
    result = {}
    for seed in range(arguments.first, arguments.first + arguments.count):
        lin, K, D = case(seed, robots)
        for dt in PERIODS:
            decided = decisions(lin.discretize(dt) if dt else lin)
            if arguments.exact:
                true = truth(lin, K, D)
                decided["wrong"] = {
                    k: [decided[k], v] for k, v in true.items() if decided[k] != v
                }
            result[f"{seed} {lin.robot} {dt:g}"] = decided
    print(json.dumps(result))


if __name__ == "__main__":
    main()
