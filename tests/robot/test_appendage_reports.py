"""Modes of flexible appendages and slosh in reports: of motions, campaigns, robots and modes."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

import fflin
from fflin.base.errors import InputError
from fflin.campaign.runs import KINDS, kinds_of
from fflin.dynamics.state import StateMap
from tests.robot.test_appendages import beam, full, hub_with_rod, servicer


def row(text, name):
    """Cells of the first line of a text that begins with a name."""
    line = next(
        line for line in text.splitlines() if line.strip().startswith(f"{name} ")
    )
    return line.strip().removeprefix(name).split()


def swinging(amplitude=0.05, **options):
    """Hub with a beam whose first mode swings freely, damped."""
    robot = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(
        appendages=[beam(1.0, 2.0, 5.0, 2)]
    )
    robot = robot.replace(damping={"beam_mode_1": 1.0, "beam_mode_2": 2.0})
    q0 = fflin.configuration(robot, {"beam_mode_1": amplitude})
    return fflin.simulate(robot, q0=q0, duration=5.0, dt=0.01, **options)


def test_a_motion_reports_its_modes_apart_from_joints(tmp_path):
    robot = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(
        appendages=[beam(1.0, 2.0, 5.0, 2)]
    )
    motion = swinging()
    assert motion.modes == ("beam_mode_1", "beam_mode_2")
    path = tmp_path / "motion.npz"
    motion.save(path)
    again = fflin.Motion.load(path)
    np.testing.assert_array_equal(again.mode_rotations, motion.mode_rotations)
    assert str(again) == str(motion)
    target = replace(motion, target=np.zeros(motion.x.shape[1]))
    for text in (str(motion), str(target)):
        largest = np.abs(motion.x[:, motion.state_names.index("q_m.beam_mode_1")]).max()
        unit, size, rotation = (
            " ".join(row(text, "modes")[:2]),
            *row(text, "beam_mode_1")[2:4],
        )
        assert unit == "kg^0.5 m"
        assert float(size) == pytest.approx(largest, rel=1e-2)
        degrees = math.degrees(robot.joint("beam_mode_1").rotation * largest)
        assert float(rotation) == pytest.approx(degrees, rel=1e-2)
        assert not any(line.startswith("joints ") for line in text.splitlines())
    assert "mode rates" in str(target)


def test_rotation_of_a_mode_is_about_the_frame_of_its_appendage():
    # The ball of a beam's mode is at |r| / |t|, and moves by 1 / |t| for a unit of the amplitude.
    appendage = beam(1.0, 2.0, 5.0, 2)
    robot = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(appendages=[appendage])
    t, r = appendage.translation[2], -appendage.rotation[1]
    assert (r / t > 0.05).all()
    assert [joint.rotation for joint in robot.modes] == pytest.approx(1.0 / r, rel=1e-9)
    # A torsion has no ball that moves: |w| is 1 / |r|.
    torsion = fflin.FlexibleAppendage(
        "root_joint", 1.0, np.zeros((3, 1)), [[0], [0], [0.5]]
    )
    turning = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(appendages=[torsion]).modes[0]
    assert turning.rotation * 0.5 == pytest.approx(1.0, rel=1e-9)


def test_a_large_amplitude_warns_that_the_model_is_linear_in_it():
    small, large = swinging(0.02), swinging(0.5)
    assert "linear" not in str(small)
    message = " ".join(str(large).split())
    assert (
        "warning: the motion is not accurate, because the model is linear in the modal amplitudes"
        in message
    )
    assert "more than 5 deg: beam_mode_1" in message


def test_settling_and_campaigns_do_not_take_modes_for_joints():
    robot = full()
    state = StateMap(robot)
    kinds = dict(
        zip(state.names, kinds_of(state, state.robot.wheels).tolist(), strict=True)
    )
    joint = list(KINDS).index("joints")
    for name in robot.joint_names:
        mode = robot.joint(name).mode
        expected = -1 if name == "wheel" else 0 if mode else joint
        assert kinds[f"q_m.{name}"] == expected
        assert (kinds[f"qdot_m.{name}"] == 0) == (mode or name == "wheel")


def test_a_campaign_judges_the_base_of_a_robot_whose_joints_are_modes():
    robot = hub_with_rod(10.0, 2.0, 1.0, 2.0).replace(
        appendages=[beam(1.0, 2.0, 5.0, 1)]
    )
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    made = fflin.monte_carlo(
        robot,
        policy,
        {"q_b": 0.01, "q_m.beam_mode_1": 0.01},
        runs=8,
        duration=2.0,
        dt=0.02,
    )
    assert made.judged == ("attitude", "position")
    joints = list(KINDS).index("joints")
    assert not made.largest[:, joints].any()
    assert made.largest_x[:, made.state_names.index("q_m.beam_mode_1")].all()


def test_modes_of_appendages_are_listed_free_and_clamped():
    robot = full().replace(gravity=(0, 0, 0))
    result = fflin.modes(fflin.linearize(robot))
    of_boom = next(
        mode for mode in result.vibrations if next(iter(mode.strain)) == "boom_mode_2"
    )
    assert sum(of_boom.strain.values()) == pytest.approx(1.0)
    assert of_boom.frequency > 2.0 * math.pi * 0.8
    text = str(result)
    line = next(
        line for line in text.splitlines() if " boom_mode_2  boom_mode_2 " in line
    )
    free, clamped, name = line.split()[:3]
    assert (float(free), name) == (
        pytest.approx(of_boom.frequency, rel=1e-5),
        "boom_mode_2",
    )
    assert float(clamped) == pytest.approx(2.0 * math.pi * 0.8, rel=1e-5)
    # 6^2 kg along x.
    mass = robot._bare.model.inertias[1].mass
    shares = row(text[text.index("effective masses") :], "boom_mode_2")
    assert float(shares[1]) == pytest.approx(100.0 * 36.0 / mass, abs=0.06)


def test_a_summary_lists_the_appendages():
    from fflin.robot.summary import robot_info

    text = robot_info(full())
    assert "boom on frame base: modes boom_mode_1, boom_mode_2" in " ".join(
        text.split()
    )
    assert re.search(r"boom_mode_2 = 25\.2662", text)
    # The modes are neither joints nor bodies nor frames of the user's.
    rigid = robot_info(servicer()[0])
    assert row(text, "(base)")[1] == row(rigid, "(base)")[1]
    assert f"{servicer()[0].n + 1} joints, 10 modes" in text


def test_default_weights_leave_modes_to_their_damping_and_name_them():
    rigid, appendages = servicer()
    gain = fflin.lqr(fflin.linearize(rigid))
    flexible = fflin.lqr(fflin.linearize(rigid.replace(appendages=appendages)))
    # The rigid part is as fast as it was: the modes are those that swing.
    decays = [
        min(-p.real for p in item.poles if abs(p.imag) < 2.0 * abs(p.real))
        for item in (gain, flexible)
    ]
    assert decays[1] == pytest.approx(decays[0], rel=0.01)
    message = " ".join(str(flexible).split())
    assert (
        "decaying more slowly: " in message and "kg^0.5 m of the joints" not in message
    )
    assert "boom_mode_2" in message[message.index("decaying more slowly") :]


def test_a_pendulum_without_gravity_is_named():
    with pytest.raises(fflin.StabilizabilityError, match=r"swing_x.*add inputs"):
        fflin.lqr(fflin.linearize(full().replace(gravity=(0, 0, 0))))
    tank = fflin.Slosh.cylinder("base", 0.1, 0.1, 1000.0, 0.04, name="tank")
    alone = fflin.load("planar_detumble", lock=["*"], appendages=[tank])
    with pytest.raises(
        fflin.StabilizabilityError, match=r"momentum of tank_x, .*a spring"
    ):
        fflin.lqr(fflin.linearize(alone))


def test_a_mode_cannot_jam_and_no_pattern_means_it():
    robot = full()
    with pytest.raises(
        InputError, match="'boom_mode_1' is a mode of a flexible appendage"
    ):
        fflin.jam(robot, "boom_mode_1")
    jammed = fflin.jam(robot, "joint_*")
    assert {mode.name for mode in robot.modes} <= {*jammed.robot.joint_names}
    assert len(fflin.jam(robot, "*").impulse) == servicer()[0].n + 1


@pytest.mark.parametrize(
    "engine", ["python", pytest.param("compiled", marks=pytest.mark.compiled)]
)
def test_a_campaign_that_draws_too_light_a_link_is_refused_by_the_mode(engine):
    robot = hub_with_rod(1.0, 0.5, 1.0, 2.0).replace(
        appendages=[beam(1.0, 2.0, 5.0, 2)]
    )
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(
        lin, np.zeros((len(lin.input_names), len(lin.state_names)))
    )
    options = {"runs": 8, "duration": 0.1, "dt": 0.05, "engine": engine}
    light = {"base.density": (-0.7, -0.5)}  # the modes have 0.8 of 2 kg
    with pytest.raises(
        InputError,
        match=r"run \d draws .*modes up to 'beam_mode_\d' exceed the inertia",
    ):
        fflin.monte_carlo(robot, policy, light, **options)
    made = fflin.monte_carlo(robot, policy, {"base.density": (-0.1, 0.2)}, **options)
    assert len(made.largest) == 8
