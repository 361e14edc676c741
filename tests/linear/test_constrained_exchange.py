"""Models and gains of robots with constraints in the coordinates of other tools."""

import numpy as np
import pytest

import fflin
from fflin.dynamics.aba import Aba
from fflin.linear.aba_route import aba_route
from fflin.linear.exchange import _jacobians_of, transformed
from fflin.linear.tool_coordinates import TOOLS
from tests.support.constrained import pendulum, random_constraints, strut
from tests.support.robots import FRAMES, mostly, random_pose


def squeezed(seed=1):
    """A random robot with springs and constraints at rest, with other axes than its reference."""
    rng = np.random.default_rng(seed)
    robot, q, _, _ = random_constraints(rng, count=1 + seed % 3, loads=False)
    rest = fflin.StateMap(robot).joint_positions(q)
    springs = dict(zip(robot.joint_names, rest.tolist(), strict=True))
    robot = robot.replace(stiffness=2.0, damping=0.3, rest=springs)
    reference = random_pose(rng, 50.0)
    return fflin.linearize(robot, q, frame=FRAMES[seed % 3], reference=reference)


def all_coordinates(lin, tool):
    """Return A and B in all coordinates of a tool, from Pinocchio's constrained derivatives."""
    robot = lin._robot
    state = fflin.StateMap(robot, reference=lin.reference, frame=lin.frame)
    A, B, _ = aba_route(Aba(state), lin.q, lin.v, lin.u0)
    still = np.zeros(6 + robot.n)
    _, source, to = _jacobians_of(robot, lin, tool, still)
    W = to.P @ source.left @ lin._all_states
    return *transformed(source, to, A, B), W


@pytest.mark.parametrize("tool", mostly(tuple(TOOLS), "drake", "spart"))
@pytest.mark.parametrize("seed", [0, 1])
def test_models_agree_with_pinocchio_in_all_coordinates(tool, seed):
    lin = squeezed(seed)
    model = lin.to(tool)
    assert len(model.state_names) == len(lin.state_names)
    assert set(model.state_names) <= set(model.output_names)
    A, B, W = all_coordinates(lin, tool)
    rows = [model.output_names.index(name) for name in model.state_names]
    S = W[rows]
    np.testing.assert_allclose(model.T, S, atol=1e-12 * np.abs(S).max())
    expected = A[rows] @ W @ np.linalg.inv(S)
    size = np.abs(expected).max()
    np.testing.assert_allclose(model.A, expected, rtol=0, atol=1e-8 * size)
    np.testing.assert_allclose(
        model.B, B[rows], rtol=0, atol=1e-8 * np.abs(B[rows]).max()
    )
    np.testing.assert_allclose(model.C @ S, W, rtol=0, atol=1e-9 * np.abs(W).max())


@pytest.mark.parametrize("tool", mostly(tuple(TOOLS), "mujoco"))
def test_gains_have_the_same_poles(tool):
    lin = squeezed()
    gain = fflin.lqr(lin)
    converted = gain.to(tool)
    model = converted.model
    poles = np.sort_complex(np.linalg.eigvals(model.A - model.B @ converted.K))
    expected = np.sort_complex(np.linalg.eigvals(lin.A - lin.B @ gain.K))
    np.testing.assert_allclose(poles, expected, atol=1e-6 * np.abs(expected).max())


def test_a_body_on_a_point_has_the_closed_form_in_tangent_coordinates():
    """Under gravity, theta'' = -m g l / I theta in mujoco's rotation vector."""
    mass, length, inertia = 3.0, 0.7, np.array((0.2, 0.3, 0.4))
    robot = pendulum(mass, inertia, length)
    model = fflin.linearize(robot, independent=["q_b"]).to("mujoco")
    about = inertia + mass * length**2 * np.array((1.0, 1.0, 0.0))
    weight = mass * 9.81 * length * np.array((1.0, 1.0, 0.0))
    frequencies = np.sort(np.abs(np.linalg.eigvals(model.A)))[2:]
    expected = np.sqrt(np.repeat(weight[:2] / about[:2], 2))
    np.testing.assert_allclose(frequencies, np.sort(expected), rtol=1e-9)


def test_inputs_that_squeeze_turn_with_the_axes_of_the_tool():
    """A load along a strut gives the same poles in every tool."""
    robot = strut(1.2, 0.9, 40.0)
    u = fflin.effort(robot, {"slide": 60.0})
    lin = fflin.linearize(robot, u=u, independent=["knee"])
    for tool in TOOLS:
        model = lin.to(tool)
        assert model.state_names == ("q_m.knee", "qdot_m.knee")
        np.testing.assert_allclose(model.A, lin.A, rtol=0, atol=1e-9)


def test_sampled_models_are_those_of_the_sampled_model():
    lin = squeezed()
    model = lin.discretize(0.05).to("drake")
    expected = model.T @ lin.discretize(0.05).A @ model.T_left
    size = np.abs(expected).max()
    np.testing.assert_allclose(model.A, expected, rtol=0, atol=1e-10 * size)
    assert model.dt == 0.05


def test_points_in_motion_files_and_steps_are_refused(tmp_path):
    rng = np.random.default_rng(0)
    robot, q, v, u = random_constraints(rng, count=1)
    with pytest.raises(fflin.InputError, match="only at an equilibrium at rest"):
        fflin.linearize(robot, q, v, u).to("drake")
    with pytest.raises(fflin.InputError, match="steps of mujoco do not support"):
        lin = squeezed()
        fflin.transform(lin._robot, lin, "mujoco", dt=0.01)
    lin.save(tmp_path / "lin.npz")
    loaded = fflin.LinearModel.load(tmp_path / "lin.npz")
    with pytest.raises(fflin.InputError, match="read from a file"):
        fflin.transform(lin._robot, loaded, "drake")
