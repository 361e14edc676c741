"""Instructions of the hot paths, as ratios to the same written by hand.

Wall-clock time differs from machine to machine and from minute to minute; counts do not, to a part
in a thousand. ``python -m benchmarks.instructions`` runs loops of N and 2 N calls under valgrind,
so that the difference holds nothing but N calls. Both sides of a ratio are Pinocchio, NumPy and
the interpreter in much the same mixture, so that it depends little on their versions.
"""

import gc
import itertools
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).parents[1]
ROBOT = "servicer_7dof"
WARM, LOOPS = 20, 24
_COUNT = "_count"  # the argument with which this module runs itself under valgrind

# Ratios on CPython 3.11, NumPy 2.4 and Pinocchio 4.1, and by what part of them they may grow: they
# repeat to five in a thousand, and one call of CRBA more at rest is a sixth.
BASELINE = {
    "at rest": 1.63,
    "operating point": 2.06,
    "constrained at rest": 2.88,
    "constrained under load": 4.18,
    "constrained in motion": 4.76,
}
TOLERANCE = 0.1

Call = Callable[[], object]


def pairs() -> dict[str, tuple[Call, Call]]:
    """Return the hot paths of fflin and the same written by hand."""
    import numpy as np
    import pinocchio as pin

    import fflin
    from benchmarks.robots import load, random_point

    point = random_point(load(ROBOT))
    model, data, q, v = point.robot.model, point.robot.create_data(), point.q, point.v
    u, order, nv = point.u, point.order, point.robot.nv
    flat = order[:, None] * nv + order
    linearizer = fflin.Linearizer(point.robot)

    def inverse() -> np.ndarray:
        still = q.copy()
        still[:3] = 0.0
        B = np.zeros((2 * nv, nv))
        pin.computeMinverse(model, data, still).take(flat, out=B[nv:], mode="clip")
        return B

    def slopes() -> tuple[np.ndarray, np.ndarray]:
        B = inverse()
        M_inverse = B[nv:]
        bias = pin.nonLinearEffects(model, data, q, v).take(order)
        a = np.empty(nv)
        a[order] = M_inverse.dot(u - bias)
        by_q, by_v, _ = pin.computeRNEADerivatives(model, data, q, v, a)
        A = np.zeros((2 * nv, 2 * nv))
        A[nv:, :nv] = -M_inverse.dot(by_q.take(flat))
        A[nv:, nv:] = -M_inverse.dot(by_v.take(flat))
        return A, B

    arms = fflin.load("dual_arm")
    bent = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}
    closed = fflin.configuration(arms, bent)
    free = fflin.Linearizer(arms)
    grasp = fflin.Weld("tool_right", "tool_left")
    grasping = arms.replace(constraints=[grasp])
    held = fflin.Linearizer(grasping)
    moving = []
    for angle in (0.0, 0.05):
        start = fflin.configuration(arms, bent | {"left_1": 0.4 + angle})
        moving.append(fflin.closed(grasping, start, np.ones(arms.nv)))
    # The points differ from call to call, because results of the last point are kept.
    points = itertools.cycle(moving)
    effort = np.ones(arms.nv)

    def under_load() -> object:
        return held(next(points)[0], None, effort)

    def in_motion() -> object:
        return held(*next(points), effort)

    return {
        "at rest": (lambda: linearizer(q), inverse),
        "operating point": (lambda: linearizer(q, v, u), slopes),
        # The other side is the robot without its constraint.
        "constrained at rest": (lambda: held(closed), lambda: free(closed)),
        "constrained under load": (under_load, lambda: free(*moving[0], effort)),
        "constrained in motion": (in_motion, lambda: free(*moving[0], effort)),
    }


def ratios() -> dict[str, float]:
    """Count the instructions of every path under valgrind, over those of the same by hand."""
    with tempfile.TemporaryDirectory() as directory:
        out = Path(directory) / "counts"
        valgrind = ["valgrind", "--tool=callgrind", f"--callgrind-out-file={out}"]
        # A count is written at each call of this function, which nothing else calls.
        valgrind += ["--dump-before=getppid"]
        done = subprocess.run(
            [
                *valgrind,
                sys.executable,
                "-W",
                "ignore",
                "-m",
                "benchmarks.instructions",
                _COUNT,
            ],
            cwd=ROOT,
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            raise RuntimeError(f"valgrind: {done.stderr[-2000:]}")
        names = done.stdout.split("\n")[:-1]
        counts = [total(Path(f"{out}.{k + 1}")) for k in range(6 * len(names))]
    found = {}
    for k, name in enumerate(names):
        own, by_hand = (counts[j + 2] - counts[j + 1] for j in (6 * k, 6 * k + 3))
        found[name] = own / by_hand
    return found


def total(path: Path) -> int:
    """Return the number of instructions in a file of callgrind."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return int(next(line.split()[1] for line in lines if line.startswith("totals:")))


def _count() -> None:
    gc.disable()
    for name, functions in pairs().items():
        print(name)
        for function in functions:
            for loops in (WARM, LOOPS, 2 * LOOPS):
                for _ in range(loops):
                    function()
                os.getppid()


if __name__ == "__main__":
    if sys.argv[1:] == [_COUNT]:
        _count()
    else:
        for path, ratio in ratios().items():
            print(f"{path:<20}{ratio:6.3f}")
