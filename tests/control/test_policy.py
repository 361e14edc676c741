"""The base class of policies: its defaults, and policies of users."""

import numpy as np
import pytest

import fflin
from fflin.control.policy import FunctionPolicy, as_policy
from fflin.simulation.lanes import not_compilable
from fflin.simulation.plan import Plan, SimulationOptions


@pytest.fixture(scope="module")
def lin():
    return fflin.linearize(fflin.load("planar_detumble"))


@pytest.fixture(scope="module")
def K(lin):
    return fflin.lqr(lin, 1.0, 1.0).K


class Integrating(fflin.Policy):
    """State feedback that counts its samples, to show whether runs share its memory."""

    sample_time = 0.1

    def __init__(self, lin, K):
        self.lin, self.K = lin, K

    @property
    def model(self):
        return self.lin

    def bind(self, robot):
        feedback = fflin.StateFeedback(self.lin, self.K).bind(robot)
        calls = [0]

        def command(t, q, v):
            calls[0] += 1
            assert calls[0] == round(t / 0.1) + 1
            return feedback(t, q, v)

        return command


def test_a_subclass_needs_bind_alone(lin):
    robot = fflin.load("planar_detumble")

    class Idle(fflin.Policy):
        def bind(self, robot):
            return lambda t, q, v: np.zeros(9)

    motion = fflin.simulate(robot, Idle(), v0=0.01 * np.ones(9), duration=0.2)
    free = fflin.simulate(robot, v0=0.01 * np.ones(9), duration=0.2)
    assert motion.q[-1] == pytest.approx(free.q[-1], abs=1e-12)
    with pytest.raises(TypeError, match="abstract"):
        type("Nothing", (fflin.Policy,), {})()


def test_a_model_gives_the_target_the_frame_and_the_sample_time(lin, K):
    robot = fflin.load("planar_detumble")
    law = Integrating(lin, K)
    q0 = fflin.configuration(robot, {"joint_1": 0.2})
    motion = fflin.simulate(robot, law, q0=q0, duration=1.0)
    sampled = fflin.StateFeedback(lin, K)
    same = fflin.simulate(robot, sampled, q0=q0, duration=1.0, sample=0.1, dt=motion.step)
    assert motion.x[-1] == pytest.approx(same.x[-1], abs=1e-12)
    assert motion.target == pytest.approx(lin.x0) and motion.frame == lin.frame


def test_runs_of_a_campaign_share_no_memory(lin, K):
    robot = fflin.load("planar_detumble")
    campaign = fflin.monte_carlo(
        robot, Integrating(lin, K), {"q_b": 0.02}, runs=3, duration=0.5, engine="python"
    )
    assert not campaign.stopped.any()


def test_data_for_compiled_code_are_not_inherited_by_another_law(lin, K):
    robot = fflin.load("planar_detumble")

    class Halved(fflin.StateFeedback):
        def bind(self, robot):
            feedback = super().bind(robot)
            return lambda t, q, v: 0.5 * feedback(t, q, v)

    assert fflin.StateFeedback(lin, K).form(robot) is not None
    assert Halved(lin, K).form(robot) is None
    plan = Plan(SimulationOptions(robot=robot, policy=Halved(lin, K), duration=1.0))
    assert "Halved is computed in Python" in not_compilable(plan) or "numba" in not_compilable(plan)


def test_functions_are_policies_and_other_objects_are_refused():
    law = as_policy(lambda t, q, v: np.zeros(9))
    assert isinstance(law, FunctionPolicy) and law.kind == "function"
    assert law.model is None and law.sample_time == 0.0 and law.fed_back == ()
    with pytest.raises(fflin.InputError, match="policy has type int"):
        as_policy(3)


def test_an_allocation_tells_what_its_policy_does(lin, K):
    inner = fflin.StateFeedback(lin, K)
    robot = fflin.load("planar_detumble")
    law = fflin.Allocation(inner, robot)
    assert law.inner is inner and law.commanded_robot is robot
    for name in ("model", "feedback_gain", "sample_time", "axes", "sensors", "fed_back"):
        assert getattr(law, name) is getattr(inner, name) or getattr(law, name) == getattr(
            inner, name
        )
    assert law.prediction(lin, fflin.StateMap(robot)) is None
    loop, dt = law.closed_loop()
    assert dt == 0.0 and loop == pytest.approx(lin.A - lin.B @ K)
