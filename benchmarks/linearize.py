"""Cost of one linearisation, as a ratio to the calls of Pinocchio and LAPACK beneath it.

Run as ``python benchmarks/linearize.py``. Each ratio is of medians of interleaved repetitions in
this one process; the result is checked once before it is timed.
"""

import platform
import statistics
import sys
import time
from collections.abc import Callable

import numpy as np
import pinocchio as pin
from scipy.linalg.lapack import dpotrf, dpotri

import fflin

ROBOTS = ("cubesat", "ets_vii", "ur5", "canadarm2", "servicer_7dof", "talos", "tiago_dual")


def medians(*functions: Callable[[], object], repetitions: int = 41) -> list[float]:
    """Median time of each function [us], their repetitions interleaved."""
    start = time.perf_counter()
    functions[0]()
    loops = max(10, int(2e-3 / (time.perf_counter() - start)))
    times: list[list[float]] = [[] for _ in functions]
    for _ in range(repetitions):
        for samples, function in zip(times, functions, strict=True):
            start = time.perf_counter()
            for _ in range(loops):
                function()
            samples.append((time.perf_counter() - start) / loops * 1e6)
    return [statistics.median(samples) for samples in times]


def bench(name: str) -> tuple[int, list[float], list[float]]:
    robot = fflin.load(name)
    model, data = robot.model, robot.create_data()
    rng = np.random.default_rng(0)
    q = pin.integrate(model, pin.neutral(model), rng.normal(size=model.nv))
    v, u = rng.normal(size=model.nv), rng.normal(size=model.nv)
    linearizer = fflin.Linearizer(robot)
    for point in (linearizer(q), linearizer(q, v, u)):
        if not fflin.check(robot, point).ok:
            sys.exit(f"{name}: wrong result")

    def floor() -> None:
        factor, _ = dpotrf(pin.crba(model, data, q))
        dpotri(factor)

    def rest() -> None:
        lin = linearizer(q)
        lin.A, lin.B  # noqa: B018 - what a caller would take

    a = np.zeros(model.nv)

    def calls() -> None:
        pin.crba(model, data, q)
        pin.cholesky.decompose(model, data)
        pin.cholesky.computeMinv(model, data)
        pin.nonLinearEffects(model, data, q, v)
        pin.computeRNEADerivatives(model, data, q, v, a)

    def point() -> None:
        lin = linearizer(q, v, u)
        lin.A, lin.B  # noqa: B018

    return robot.n, medians(rest, floor), medians(point, calls)


def bench_equipped() -> list[float]:
    """Time a point of servicer_7dof with 12 thrusters, 3 wheels and two outputs of a frame."""
    rng = np.random.default_rng(0)
    robot = fflin.load("servicer_7dof")
    thrusters = [
        fflin.Thruster(frame, rng.normal(size=3), rng.normal(size=3))
        for frame in ("base", "base", "base", "link_3", "link_5", "panel_left")
        for _ in range(2)
    ]
    wheels = [fflin.ReactionWheel(axis, inertia=0.03) for axis in np.eye(3)]
    robot = robot.replace(
        inputs=[*thrusters, *wheels], outputs=[fflin.FramePose("tool"), fflin.FrameVelocity("tool")]
    )
    model, data = robot.model, robot.create_data()
    q = pin.integrate(model, pin.neutral(model), rng.normal(size=model.nv))
    v, u = rng.normal(size=model.nv), rng.normal(size=len(robot.inputs))
    linearizer = fflin.Linearizer(robot)
    if not fflin.check(robot, linearizer(q, v, u)).ok:
        sys.exit("servicer_7dof with thrusters and wheels: wrong result")
    a, wrenches = np.zeros(model.nv), pin.StdVec_Force(model.njoints, pin.Force.Zero())
    tool = model.frames[model.getFrameId("tool", pin.FrameType.BODY)]
    carriers = {model.frames[model.getFrameId(item.frame)].parentJoint for item in thrusters}
    place = tool.parentJoint, tool.placement, pin.ReferenceFrame.LOCAL

    def calls() -> None:
        pin.crba(model, data, q)
        pin.cholesky.decompose(model, data)
        pin.cholesky.computeMinv(model, data)
        pin.computeJointJacobians(model, data, q)
        for joint in carriers:
            pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL)
        pin.nonLinearEffects(model, data, q, v)
        pin.computeRNEADerivatives(model, data, q, v, a, wrenches)
        pin.computeForwardKinematicsDerivatives(model, data, q, v, a)
        for _ in range(2):
            pin.getFrameVelocityDerivatives(model, data, *place)
        pin.getFrameVelocity(model, data, *place)

    def point() -> None:
        lin = linearizer(q, v, u)
        lin.A, lin.B, lin.C, lin.D  # noqa: B018

    return medians(point, calls)


def main() -> None:
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu = next(line.split(":")[1].strip() for line in file if "model name" in line)
    except (OSError, StopIteration):
        pass
    print(
        f"{cpu}; Python {platform.python_version()}, pin {pin.__version__}, numpy {np.__version__}"
    )
    print("median times [us]; at rest against crba + dpotrf + dpotri, at an operating point")
    print("against the Pinocchio calls that it makes\n")
    print(
        f"{'robot':<15}{'n':>4}{'rest':>9}{'floor':>9}{'ratio':>7}{'point':>10}{'calls':>9}{'ratio':>7}"
    )
    for name in ROBOTS:
        n, (rest, floor), (point, calls) = bench(name)
        print(
            f"{name:<15}{n:>4}{rest:>9.2f}{floor:>9.2f}{rest / floor:>7.2f}"
            f"{point:>10.2f}{calls:>9.2f}{point / calls:>7.2f}"
        )
    point, calls = bench_equipped()
    print("\nservicer_7dof with 12 thrusters, 3 wheels, and the tool's pose and velocity:")
    print(f"{'':<44}{point:>10.2f}{calls:>9.2f}{point / calls:>7.2f}")


if __name__ == "__main__":
    main()
