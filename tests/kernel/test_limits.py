"""The limits of the compiled engine: each has a reason, and every function states it."""

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.campaign.runs import CampaignJob, notes_on_engine
from fflin.kernel import limits
from fflin.kernel.limits import LIMITS, Task, reason_against
from fflin.robot.joints import ROOT

CUBESAT = fflin.load("cubesat")
IN_ELLIPSE = CUBESAT.replace(orbit={"perigee": 500e3, "eccentricity": 0.1})


def with_displaced_root():
    model = CUBESAT.model.copy()
    model.jointPlacements[ROOT] = pin.SE3(np.eye(3), np.array([0.0, 0.0, 1.0]))
    return fflin.from_model(model, name="displaced")


def with_displaced_axis():
    """A robot with a joint whose axis does not pass through the origin of its frame."""
    hinge = pin.JointModelComposite(1)
    hinge.addJoint(pin.JointModelRX(), pin.SE3(np.eye(3), np.array([0.1, 0.4, -0.3])))
    model = CUBESAT.model.copy()
    body = pin.Inertia(1.0, np.zeros(3), np.diag([0.3, 0.4, 0.5]))
    joint = model.addJoint(ROOT, hinge, pin.SE3.Identity(), "hinge")
    model.appendBodyToJoint(joint, body, pin.SE3.Identity())
    return fflin.from_model(model, name="composite")


def in_field(field):
    return CUBESAT.replace(
        orbit=fflin.CircularOrbit(500e3, field=field),
        inputs=[fflin.Magnetorquer((1, 0, 0))],
    )


TASKS = {
    "the outputs are not the state": Task(robots=(CUBESAT,), outputs=True),
    "events are computed in Python": Task(robots=(CUBESAT,), events=True),
    "callbacks are called in Python": Task(robots=(CUBESAT,), callback=True),
    "disturbances are computed in Python": Task(robots=(CUBESAT,), disturbance=True),
    "lags of outputs are not computed": Task(robots=(CUBESAT,), lagging=True),
    "a Mpc is computed in Python": Task(robots=(CUBESAT,), python_policy="Mpc"),
    "sweeps of 'cubesat' in its elliptic orbit": Task(robots=(CUBESAT, IN_ELLIPSE)),
    "the magnetic field of 'cubesat' is a function": Task(
        robots=(in_field(lambda t, position: np.zeros(3)),), simulated=True
    ),
    "sweeps of 'cubesat' with its magnetorquers": Task(robots=(in_field("dipole"),)),
    "a joint of 'composite' does not": Task(robots=(with_displaced_axis(),)),
    "the root joint of 'displaced'": Task(
        robots=(with_displaced_root(),), simulated=True
    ),
    "its sample time differs": Task(robots=(CUBESAT,), own_sample_time=True),
    "noise is evaluated at every stage": Task(robots=(CUBESAT,), noise_at_stages=True),
    "no frame": Task(robots=(CUBESAT,), measurements="no frame"),
}


def test_each_limit_has_a_task_whose_reason_it_is(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    met = []
    for reason, task in TASKS.items():
        assert reason_against(task).startswith(reason)
        met.append(next(i for i, limit in enumerate(LIMITS) if limit.subject(task)))
    assert reason_against(Task(robots=(CUBESAT,), simulated=True)) == ""
    assert reason_against(Task(robots=(with_displaced_root(),))) == ""
    assert reason_against(Task(robots=(in_field("dipole"),), simulated=True)) == ""
    monkeypatch.setattr(limits, "numba_is_there", lambda: False)
    assert "numba" in reason_against(Task(robots=(CUBESAT,)))
    assert sorted([0, *met]) == list(range(len(LIMITS)))


def test_sweeps_simulations_and_campaigns_state_the_same_reason(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    options = {"engine": "compiled"}
    robot = with_displaced_axis()
    reason = "a joint of 'composite' does not move"
    with pytest.raises(fflin.InputError, match=reason):
        fflin.sweep(robot, robot.neutral()[None], **options)
    with pytest.raises(fflin.InputError, match=reason):
        fflin.simulate(robot, duration=1.0, **options)
    with pytest.raises(fflin.InputError, match=reason):
        fflin.monte_carlo(robot, None, {"q_b": 0.02}, runs=2, duration=1.0, **options)


WHY = "because a joint of 'composite' does not move along a screw with a fixed axis"


def test_a_sweep_states_why_its_models_were_computed_in_python(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    robot = with_displaced_axis()
    q = np.tile(robot.neutral(), (3, 1))
    assert fflin.sweep(robot, q)[1:].notes == (f"linearised in Python, {WHY}",)
    assert fflin.sweep(robot, q, engine="python").notes == ()


def test_runs_state_why_they_are_simulated_in_python(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    job = CampaignJob(with_displaced_axis(), None, None, 0, None, {"duration": 0.1})
    assert notes_on_engine(job, None) == (f"simulated in Python, {WHY}",)
    assert notes_on_engine(job, "python") == ()


@pytest.mark.exhaustive
def test_validity_and_funnels_state_why_they_were_simulated_in_python(
    monkeypatch, tmp_path
):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    robot = with_displaced_axis()
    lin = fflin.linearize(robot)
    reach = fflin.validity(robot, lin, fflin.lqr(lin), samples=1)
    rest = fflin.Trajectory(
        robot,
        [0.0, 0.1, 0.2],
        np.tile(robot.neutral(), (3, 1)),
        np.zeros((3, robot.nv)),
        np.zeros((3, len(lin.u0))),
    )
    schedule = fflin.tvlqr(fflin.linearize_trajectory(robot, rest))
    goal = {"attitude": 170.0}
    tube = fflin.funnel(robot, schedule, goal, samples=1, knots=1, dt=0.1)
    tube.save(tmp_path / "funnel.npz")
    for result in (reach, tube, fflin.Funnel.load(tmp_path / "funnel.npz", robot)):
        assert result.notes == (f"simulated in Python, {WHY}",)
        assert result.notes[0] in " ".join(str(result).split())


def test_a_campaign_states_why_its_runs_were_simulated_in_python(monkeypatch):
    monkeypatch.setattr(limits, "numba_is_there", lambda: True)
    robot = with_displaced_axis()
    runs = fflin.monte_carlo(robot, None, {"q_b": 0.02}, runs=2, duration=0.1)
    (note,) = runs.notes
    assert note == f"simulated in Python, {WHY}"
    assert note in " ".join(str(runs).split())
    options = {"runs": 2, "duration": 0.1, "engine": "python"}
    assert fflin.monte_carlo(robot, None, {"q_b": 0.02}, **options).notes == ()
