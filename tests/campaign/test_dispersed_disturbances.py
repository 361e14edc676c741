"""Dispersed constant torques and forces on the base, compared with their closed forms."""

import numpy as np
import pytest

import fflin
from tests.support.robots import free_body

BODY = free_body((4.0, 5.0, 6.0))
WAVE = {"amplitude": (0.0, 0.0, 0.02), "frequency": 0.3, "phase": 0.4}
DURATION = 2.0
ENGINES = ["python", pytest.param("compiled", marks=pytest.mark.compiled)]


def campaign_of(robot, spreads, engine, runs=4, **options):
    if engine == "compiled":
        pytest.importorskip("numba")
    options = {"duration": DURATION, "dt": 0.1} | options
    return fflin.monte_carlo(robot, None, spreads, runs=runs, engine=engine, **options)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_drawn_force_displaces_the_body_by_half_its_acceleration_times_t_squared(
    engine,
):
    robot = BODY.replace(disturbance={"F_b": (0.5, 0.0, -0.2)})
    # The force is in inertial axes, so a spin of the body does not matter.
    v0 = fflin.velocity(robot, {"omega_b.x": 0.4, "omega_b.y": -0.3})
    campaign = campaign_of(robot, {"F_b.disturbance": 0.3}, engine, v0=v0)
    assert campaign.names == tuple(f"F_b.{axis}.disturbance" for axis in "xyz")
    force = campaign.drawn + np.array((0.5, 0.0, -0.2))
    assert np.abs(campaign.drawn).min() > 1e-3
    expected = 0.5 * force / robot.mass * DURATION**2
    assert campaign.q[:, :3] == pytest.approx(expected, abs=1e-13)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_drawn_torque_adds_to_the_disturbance_of_the_robot(engine):
    robot = BODY.replace(disturbance={"tau_b": [(0.01, 0.0, 0.0), WAVE]})
    spreads = {"tau_b.x.disturbance": (0.02, 0.05), "base.mass": 0.1, "tau_b.gain": 0.1}
    campaign = campaign_of(robot, spreads, engine)
    at = campaign.names.index("tau_b.x.disturbance")
    for run, drawn in enumerate(campaign.drawn[:, at].tolist()):
        total = {"tau_b": [(0.01 + drawn, 0.0, 0.0), WAVE]}
        alone = fflin.simulate(
            BODY.replace(disturbance=total), duration=DURATION, dt=0.1, engine="python"
        )
        assert campaign.q[run] == pytest.approx(alone.q[-1], abs=1e-12)
        motion = campaign.replay(run)
        assert np.array_equal(motion.q[-1], campaign.q[run])


def test_an_unknown_disturbance_is_refused():
    with pytest.raises(fflin.UnknownNameError, match="disturbance to disperse"):
        campaign_of(BODY, {"tau_c.disturbance": 0.3}, "python")


@pytest.mark.parametrize("engine", ENGINES)
def test_drawn_factors_multiply_the_amplitudes_of_each_component(engine):
    wave = {"amplitude": (0.01, 0.0, -0.02), "frequency": 0.3, "axes": "inertial"}
    push = {"amplitude": (0.1, 0.2, 0.3), "frequency": 0.7, "constant": (0.1, 0, 0)}
    robot = BODY.replace(disturbance={"tau_b": [WAVE, wave], "F_b": [push]})
    spreads = {"tau_b.amplitude": 0.3, "F_b.y.amplitude": (0.5, 1.0)}
    if engine == "compiled":
        spreads["F_b.x.disturbance"] = 0.1
    campaign = campaign_of(robot, spreads, engine)
    # The amplitude about y is zero, so that no factor is drawn for it.
    names = ["tau_b.x.amplitude", "tau_b.z.amplitude", "F_b.y.amplitude"]
    assert [x for x in campaign.names if x.endswith("amplitude")] == names
    columns = [campaign.names.index(name) for name in names]
    for run, drawn in enumerate(campaign.drawn):
        x, z, y = (1.0 + drawn[columns]).tolist()
        assert min(abs(x - 1.0), abs(z - 1.0)) > 1e-3 and y >= 1.5
        more = 0.0
        if engine == "compiled":
            more = float(drawn[campaign.names.index("F_b.x.disturbance")])
        total = {
            "tau_b": [
                {**WAVE, "amplitude": (0.0, 0.0, 0.02 * z)},
                {**wave, "amplitude": (0.01 * x, 0.0, -0.02 * z)},
            ],
            "F_b": [
                {**push, "amplitude": (0.1, 0.2 * y, 0.3)},
                (more, 0.0, 0.0),
            ],
        }
        alone = fflin.simulate(
            BODY.replace(disturbance=total), duration=DURATION, dt=0.1, engine="python"
        )
        assert campaign.q[run] == pytest.approx(alone.q[-1], abs=1e-12)
        assert np.array_equal(campaign.replay(run).q[-1], campaign.q[run])


def test_an_amplitude_of_no_periodic_disturbance_is_refused():
    with pytest.raises(fflin.InputError, match="has no periodic disturbance"):
        campaign_of(BODY, {"tau_b.amplitude": 0.3}, "python")
    robot = BODY.replace(disturbance={"tau_b": [WAVE]})
    with pytest.raises(fflin.UnknownNameError, match="amplitude to disperse"):
        campaign_of(robot, {"tau_b.x.amplitude": 0.3}, "python")
    with pytest.raises(fflin.InputError, match="expected more than -1"):
        campaign_of(robot, {"tau_b.amplitude": (-2.0, -1.5)}, "python")


def test_a_quantity_names_its_components_as_in_the_filter():
    robot = fflin.load(
        "cubesat",
        inputs=[fflin.BaseTorque()],
        outputs=[fflin.BasePose(), fflin.Gyroscope("base")],
    )
    lin = fflin.linearize(robot).discretize(0.5)
    noise = {"q_b": 1e-9, "r_b": 1e-4, "gyroscope": 1e-9}
    estimator = fflin.kalman(lin, {"omega_b": 1e-9}, noise)
    law = fflin.OutputFeedback(lin, fflin.lqg(fflin.lqr(lin), estimator))
    options = {"runs": 2, "duration": 1.0, "dt": 0.25, "engine": "python"}
    named, listed = (
        fflin.monte_carlo(
            robot, law, {f"{key}.noise": 1e-4, f"{key}.sensor": 1e-3}, **options
        )
        for key in ("gyroscope", "*.gyroscope.*")
    )
    assert named.names == listed.names and len(named.names) == 1 + 2 * 3
    assert np.array_equal(named.q, listed.q)
