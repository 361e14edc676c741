"""Print the table of docs/conventions.md on frames: ``python docs/scripts/frames.py [ROBOT ...]``.

The table counts the loops that settle with feedback in each frame. Each of ten random postures
within the joint limits starts with the base rotated about a random axis and displaced by 0.5 m per
90 deg.
"""

import sys
import warnings
from dataclasses import replace
from functools import partial

import numpy as np

import fflin
from fflin.batch.run import Execution
from fflin.campaign.settling import OUTCOMES, Loop, settle

FRAMES = ("hybrid", "local", "world")
ROBOTS, TURNS, POSTURES = ("canadarm2", "ur5", "panda", "servicer_7dof"), (20, 60, 90, 120, 150), 10
GAINS = {
    "lqr(lin)": fflin.lqr,
    "acceleration_lqr(lin, 1, 1, 1)": lambda lin: fflin.acceleration_lqr(lin, 1.0, 1.0, 1.0),
}


def settled(robot: fflin.Robot, design: str, degrees: float) -> str:
    """Return the number of loops that settle in each frame, such as 10/9/0."""
    counts = dict.fromkeys(FRAMES, 0)
    for k, q in enumerate(fflin.random_configurations(robot, POSTURES).rows(0, POSTURES)):
        lin = fflin.linearize(robot, q)
        loop = Loop(robot, lin, GAINS[design](lin))
        x = loop.displaced(np.random.default_rng(k), degrees, 0.5 * degrees / 90.0, 0.0)
        x = (x - loop.start)[None]
        for frame in FRAMES:
            there = Loop(robot, replace(lin, frame=frame), loop.policy.K)
            runs_of = partial(there.runs, False, None, 0.0, "python")
            arrays = settle(runs_of, x, Execution())
            counts[frame] += OUTCOMES[int(arrays["outcome"][0])] == "settled"
    return "/".join(map(str, counts.values()))


def main() -> None:
    """Print the table."""
    warnings.simplefilter("ignore")
    titles = "".join(f" {degrees} deg |" for degrees in TURNS)
    print(f"| gain, robot |{titles}\n| --- |{' --- |' * len(TURNS)}")
    for design in GAINS:
        for name in sys.argv[1:] or ROBOTS:
            robot = fflin.load(name)
            cells = "".join(f" {settled(robot, design, degrees)} |" for degrees in TURNS)
            print(f"| `{design}`, {name} |{cells}", flush=True)


if __name__ == "__main__":
    main()
