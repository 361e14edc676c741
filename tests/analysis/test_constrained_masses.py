"""Effective masses of robots with closed loops, compared with equal trees and with the motion."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.support.constrained import Build, at


def body(mass):
    return pin.Inertia(mass, np.array((0.1, -0.05, 0.2)), 0.1 * mass * np.eye(3))


def sliders(*, loop):
    """A mass of 3 kg on a slider with a spring; with `loop`, it is two masses welded together."""
    build = Build(body(20.0))
    springs = {"rail": 50.0}
    constraints = []
    first = build.add(
        1, pin.JointModelPX(), at(0.5), "rail", body(2.0 if loop else 3.0)
    )
    build.add(first, pin.JointModelRZ(), at(0.2), "mast", body(1.5))
    if loop:
        build.add(1, pin.JointModelPX(), at(0.5), "other", body(1.0))
        springs = {"rail": 20.0, "other": 30.0}
        constraints = [fflin.Weld("rail", "other")]
    return build.robot(
        "sliders", stiffness=springs | {"mast": 4.0}, constraints=constraints
    )


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_two_sliders_that_are_welded_are_one_slider(angle):
    results = []
    for loop in (False, True):
        robot = sliders(loop=loop)
        q = fflin.configuration(robot, {"mast": angle})
        results.append(fflin.effective_masses(fflin.linearize(robot, q)))
    tree, loop = results
    for key in ("frequencies", "masses", "inertias", "free", "residual", "total"):
        np.testing.assert_allclose(
            getattr(loop, key), getattr(tree, key), rtol=1e-9, atol=1e-10
        )


def test_the_parts_add_up_and_the_base_weld_gives_the_frequencies():
    springs = {"left_1": 30.0, "right_2": 20.0}
    weld = fflin.Weld("tool_left", "tool_right")
    robot = fflin.load("dual_arm", stiffness=springs, constraints=[weld])
    bent = {"left_1": 0.4, "left_2": 0.6, "right_1": -0.4, "right_2": -0.6}
    q = fflin.configuration(robot, bent)
    rest = {name: bent[name] for name in springs}
    robot = robot.replace(rest=rest)
    result = fflin.effective_masses(fflin.linearize(robot, q))
    parts = result.participation @ result.participation.T
    np.testing.assert_allclose(
        parts + result.free + result.residual, result.total, atol=1e-9
    )
    clamped = robot.replace(constraints=[*robot.constraints, fflin.Weld("base")])
    poles = np.linalg.eigvals(fflin.linearize(clamped, q).A)
    frequencies = np.sort(np.abs(poles.imag))[::2]
    np.testing.assert_allclose(
        result.frequencies, frequencies[-len(result.frequencies) :], rtol=1e-8
    )
    with pytest.raises(fflin.InputError, match="held in inertial space"):
        fflin.effective_masses(fflin.linearize(clamped, q))
