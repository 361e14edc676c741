"""Functions that do not support constraints refuse a robot with constraints."""

import pytest

import fflin


@pytest.fixture(scope="module")
def robot():
    return fflin.load(
        "dual_arm", constraints=[fflin.Weld("tool_left", "tool_right", name="grasp")]
    )


@pytest.fixture(scope="module")
def lin(robot):
    return fflin.linearize(robot)


def along(robot, lin):
    motion = fflin.simulate(
        robot, q0=lin.q, duration=0.2, dt=0.1, engine="python", progress=False
    )
    return fflin.linearize_trajectory(robot, motion.trajectory())


CALLS = {
    "batch.to": lambda robot, lin: fflin.sweep(robot, lin.q[None]).to("drake"),
    "along.to": lambda robot, lin: along(robot, lin).to("pinocchio"),
    "from_tool": lambda robot, lin: fflin.from_tool(robot, "drake", lin.q),
    "generalized_jacobian": lambda robot, _: fflin.generalized_jacobian(
        robot, frame="tool_left"
    ),
    "linearize_orbit": lambda robot, _: fflin.linearize_orbit(
        robot.replace(orbit=500e3)
    ),
    "relative_equilibria": lambda robot, _: fflin.relative_equilibria(robot),
}


@pytest.mark.parametrize("name", CALLS)
def test_a_function_without_support_names_the_constraints(name, robot, lin):
    with pytest.raises(fflin.InputError, match=r"not support constraints.*grasp"):
        CALLS[name](robot, lin)
