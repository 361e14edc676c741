"""The base class of policies: its defaults, and policies of users."""

import numpy as np
import pytest

import fflin
from fflin.control.policy import FunctionPolicy, as_policy
from fflin.simulation.lanes import form_of, not_compilable
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
    same = fflin.simulate(
        robot, sampled, q0=q0, duration=1.0, sample=0.1, dt=motion.step
    )
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

    class Mixin:
        def bind(self, robot):
            return lambda t, q, v: np.ones(9)

    class Mixed(Mixin, fflin.StateFeedback):
        pass

    assert fflin.StateFeedback(lin, K).form(robot) is not None
    for law in (Halved(lin, K), Mixed(lin, K)):
        assert (
            law.form(robot) is None
            and law.feedback_gain is None
            and law.closed_loop() is None
        )
        assert law.prediction(lin, fflin.StateMap(robot)) is None and law.model is lin
        plan = Plan(SimulationOptions(robot=robot, policy=law, duration=1.0))
        reason = not_compilable(plan)
        assert f"{law.kind} is computed in Python" in reason or "numba" in reason


def test_data_that_do_not_fit_the_robot_are_refused(lin, K):
    robot = fflin.load("planar_detumble")
    whole = fflin.StateFeedback(lin, K).form(robot)

    class Law(fflin.StateFeedback):
        data = None

        def form(self, robot):
            return self.data

    for data, words in (
        (whole._replace(gains=whole.gains[:, :, :5]), "gains"),
        (whole._replace(offsets=whole.offsets[0]), "offsets"),
        (whole._replace(x0=np.full(18, np.nan)), "x0"),
        (whole._replace(grid={"joint_1": np.array([0.0, 1.0])}), "offsets"),
        (3, "StateForm"),
    ):
        Law.data = data
        with pytest.raises(fflin.InputError, match=words):
            form_of(Law(lin, K), robot)


@pytest.mark.parametrize("value", [-0.1, np.nan, "often"])
def test_a_sample_time_is_positive(lin, K, value):
    class Law(Integrating):
        sample_time = value

    with pytest.raises(fflin.InputError, match="sample_time of Law"):
        fflin.simulate(fflin.load("planar_detumble"), Law(lin, K), duration=1.0)


def test_an_invalid_policy_is_named():
    robot = fflin.load("planar_detumble")

    class Empty(fflin.Policy):
        def bind(self, robot):
            return None

    with pytest.raises(fflin.InputError, match=r"Empty.bind\(robot\) returned"):
        fflin.simulate(robot, Empty(), duration=1.0)
    with pytest.raises(fflin.InputError, match="class Empty"):
        fflin.simulate(robot, Empty, duration=1.0)


def test_a_gain_of_another_model_is_refused(lin):
    gain = fflin.lqr(lin)
    robot = fflin.load("planar_detumble")
    moved = fflin.linearize(robot, fflin.configuration(robot, {"joint_1": 0.3}))
    for model, words in (
        (moved, "point"),
        (lin.discretize(0.1), "sample time"),
        (fflin.linearize(robot, frame="local"), "frame"),
        (fflin.linearize(fflin.load("ets_vii")), "states"),
    ):
        with pytest.raises(fflin.InputError, match=words):
            fflin.StateFeedback(model, gain)


def test_functions_are_policies_and_other_objects_are_refused():
    law = as_policy(lambda t, q, v: np.zeros(9))
    assert isinstance(law, FunctionPolicy) and law.kind == "function"
    assert law.model is None and law.sample_time == 0.0 and law.fed_back == ()
    with pytest.raises(fflin.InputError, match="policy has type int"):
        as_policy(3)


def test_an_allocation_has_the_attributes_of_its_policy(lin, K):
    inner = fflin.StateFeedback(lin, K)
    robot = fflin.load("planar_detumble")
    law = fflin.Allocation(inner, robot)
    assert law.inner is inner and law.commanded_robot is robot
    for name in (
        "model",
        "feedback_gain",
        "sample_time",
        "axes",
        "sensors",
        "fed_back",
    ):
        assert getattr(law, name) is getattr(inner, name) or getattr(
            law, name
        ) == getattr(inner, name)
    assert law.prediction(lin, fflin.StateMap(robot)) is None
    loop, dt = law.closed_loop()
    assert dt == 0.0 and loop == pytest.approx(lin.A - lin.B @ K)


def idle(**members):
    """Return a policy of a user whose members have the given values."""

    class Idle(fflin.Policy):
        def bind(self, robot):
            return lambda t, q, v: np.zeros(robot.nv)

    for name, value in members.items():
        setattr(Idle, name, value)
    return Idle()


@pytest.mark.parametrize(
    ("members", "message"),
    [
        ({"model": "planar"}, "Idle.model has type str, expected a fflin.LinearModel"),
        ({"feedback_gain": 3.0}, r"feedback_gain has shape \(\), expected \(nu, nx\)"),
        ({"feedback_gain": "K"}, "feedback_gain contains <U1 values"),
        ({"feedback_gain": np.full((9, 18), np.nan)}, "every entry must be finite"),
        ({"closed_loop": lambda self: np.eye(2)}, "type ndarray, expected a matrix"),
        (
            {"closed_loop": lambda self: (np.ones((2, 3)), 0.0)},
            r"matrix of shape \(2, 3\), expected \(n, n\)",
        ),
        ({"closed_loop": lambda self: (np.full((2, 2), np.inf), 0.0)}, "finite"),
        ({"closed_loop": lambda self: (np.eye(2), -1.0)}, "dt of .* is -1 s"),
        ({"reference_motion": 5}, "reference_motion has type int, expected a function"),
        ({"reference_motion": property(lambda self: lambda: 0)}, r"function of \(t\)"),
        (
            {"reference_motion": property(lambda self: lambda t: 3)},
            r"reference_motion\(0\) has type int, expected q",
        ),
        (
            {"reference_motion": property(lambda self: lambda t: ([0], [0], [0]))},
            r"q of Idle.reference_motion\(0\) has shape \(1,\), expected \(13,\)",
        ),
        (
            {"initial_inputs_for": lambda self, names: np.zeros(2)},
            r"initial_inputs_for\(names\) has shape \(2,\), expected \(9,\)",
        ),
        ({"initial_inputs_for": lambda self, names: "none"}, "expected real numbers"),
    ],
)
def test_members_of_a_users_policy_are_checked(members, message):
    robot = fflin.load("planar_detumble")
    with pytest.raises(fflin.InputError, match=message):
        fflin.simulate(robot, idle(**members), duration=0.1, dt=0.05)


def test_a_gain_of_a_users_policy_must_fit_its_model(lin):
    robot = fflin.load("planar_detumble")
    law = idle(model=lin, feedback_gain=np.ones((2, 18)))
    with pytest.raises(fflin.InputError, match=r"shape \(2, 18\), expected \(9, 18\)"):
        fflin.simulate(robot, law, duration=0.1, dt=0.05)


def test_a_model_of_another_robot_is_named_as_the_model_of_the_policy(lin):
    with pytest.raises(
        fflin.InputError,
        match=r"the model of the policy \(Idle\) is a model of 'planar",
    ):
        fflin.simulate(fflin.load("ets_vii"), idle(model=lin), duration=0.1, dt=0.05)


def test_an_object_in_place_of_a_gain_is_named_by_its_type(lin):
    estimator = fflin.kalman(lin, 1e-3, 1e-4)
    with pytest.raises(fflin.InputError, match="has type Estimator, expected real"):
        fflin.StateFeedback(lin, estimator)
