"""Disturbances by name, in the axes of the inputs."""

import numpy as np
import pytest

import fflin

SPIN = {"omega_b.x": 0.4, "omega_b.z": -0.7, "v_b.y": 0.2}


@pytest.fixture(scope="module")
def robot():
    return fflin.load("astrobee_arm")


def flown(robot, disturbance, **options):
    v0 = fflin.velocity(robot, SPIN)
    return fflin.simulate(
        robot,
        v0=v0,
        duration=1.0,
        dt=0.02,
        project=False,
        disturbance=disturbance,
        **options,
    )


@pytest.mark.parametrize("frame", ["hybrid", "local", "world"])
def test_forces_act_in_the_axes_of_the_inputs(robot, frame):
    """A constant input and a disturbance of the same name are the same force."""
    given = {
        "tau_b": (0.02, -0.01, 0.03),
        "F_b.x": 0.3,
        "F_b.z": -0.1,
        "tau_m.arm_distal": 0.01,
    }
    values = dict(zip(("tau_b.x", "tau_b.y", "tau_b.z"), given["tau_b"], strict=True))
    u = fflin.effort(robot, values | {key: given[key] for key in list(given)[1:]})
    v0 = fflin.velocity(robot, SPIN)
    options = {"duration": 1.0, "dt": 0.02, "project": False, "frame": frame}
    expected = fflin.simulate(robot, lambda t, q, v: u, v0=v0, **options)
    motion = flown(robot, given, frame=frame)
    assert motion.q == pytest.approx(expected.q, abs=1e-12)
    assert motion.v == pytest.approx(expected.v, abs=1e-12)


def test_a_force_in_reference_axes_adds_its_impulse_to_the_momentum(robot):
    force = np.array((0.3, -0.2, 0.1))
    motion = flown(robot, lambda t, q, v: {"F_b": force})
    gained = motion.momentum[-1, 3:] - motion.momentum[0, 3:]
    assert gained == pytest.approx(force, abs=1e-8)


def test_an_array_keeps_its_order_and_warns(robot):
    tau = np.array((0.02, -0.01, 0.03))
    array = np.concatenate((np.zeros(3), tau, np.zeros(2)))
    with pytest.warns(fflin.FflinWarning, match="by name"):
        old = flown(robot, lambda t, q, v: array)
    assert np.array_equal(old.v, flown(robot, {"tau_b": tau}).v)


def test_an_unknown_force_is_refused(robot):
    with pytest.raises(fflin.UnknownNameError, match="tau_c"):
        flown(robot, {"tau_c": 1.0})
    with pytest.raises(fflin.InputError, match="tau_b"):
        flown(robot, {"tau_b": (1.0, 2.0)})


def test_a_function_in_a_mapping_is_refused_with_the_form_that_varies_in_time(robot):
    with pytest.raises(
        fflin.InputError, match=r"is a function, expected a number; .*'tau_b.x': nu"
    ):
        flown(robot, {"tau_b.x": np.sin})
    motion = flown(robot, lambda t, q, v: {"tau_b.x": np.sin(t)})
    assert np.ptp(motion.energy) > 0.0


@pytest.mark.parametrize(
    "option, arguments", [("disturbance", 3), ("callback", 4), ("policy", 3)]
)
def test_a_function_of_other_arguments_is_refused(robot, option, arguments):
    names = "(t, q, v, u)" if arguments == 4 else "(t, q, v)"
    options = {"duration": 0.1, "dt": 0.05, option: lambda t: None}
    with pytest.raises(fflin.InputError) as error:
        fflin.simulate(robot, **options)
    assert (
        str(error.value)
        == f"{option} is a function of (t), expected a function of {names}"
    )
