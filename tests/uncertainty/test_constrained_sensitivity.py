"""Derivatives of models of robots with constraints with respect to parameters."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from tests.linear.test_constraints import (
    flexible,
    in_orbit,
    mimicking,
    moving,
    with_wheels,
)
from tests.support.constrained import (
    Build,
    at,
    parallelogram,
    pendulum,
    random_constraints,
    strut,
)
from tests.support.marks import exhaustive
from tests.support.robots import FRAMES, random_pose
from tests.uncertainty.test_sensitivity import changed, derived, everything

# Truncation of fourth-order differences with relative changes of M by 2e-3, with a margin.
DIFFERENCES = 1e-7


def together(parts):
    return np.concatenate([part.ravel() for part in parts])


def apart_from_differences(lin, parameter, source, step, derivatives):
    """Return the error of derivatives, relative to fourth-order differences of models.

    `source` is a function that returns the model for a change of the parameter.
    """
    one, two, minus_one, minus_two = (
        together(everything(source(count * step))) for count in (1, 2, -1, -2)
    )
    expected = (8.0 * (one - minus_one) - (two - minus_two)) / (12.0 * step)
    # Rounding errors of the models divided by the step.
    size = np.abs(together(everything(lin))).max()
    largest = max(np.abs(expected).max(), 1e-6 * size / abs(step))
    result = together(derived(derivatives[parameter]))
    return np.abs(result - expected).max() / largest


def body_errors(lin, relinearised, rng, count):
    """Return the errors of the derivatives by some parameters of bodies."""
    S = fflin.sensitivity(lin)
    names = [name for name, one in S.parameters.items() if one.bodies]
    errors = {}
    for name in rng.choice(names, count, replace=False):
        bodies = S.parameters[name].bodies
        step = 2e-3 / S._derivatives.fraction(bodies)

        def source(size, bodies=bodies):
            return relinearised(changed(lin._robot, bodies, size))

        errors[str(name)] = apart_from_differences(lin, name, source, step, S)
    return errors


# --- closed forms


@pytest.mark.parametrize("frame", FRAMES)
def test_a_pendulum_has_the_derivatives_of_its_closed_form(frame):
    """The weight is a load: also its derivatives are exact."""
    mass, length, inertia, g = 3.0, 0.7, np.array((0.2, 0.3, 0.4)), 9.81
    robot = pendulum(mass, inertia, length)
    lin = fflin.linearize(robot, frame=frame, independent=["q_b"])
    S = fflin.sensitivity(lin)
    about_point = inertia + mass * length**2 * np.array((1.0, 1.0, 0.0))
    # A[omega, q_b] = -2 m g l / I, and B[omega, tau] = 1 / I
    of_A = -2.0 * mass * g * length / about_point[:2]
    of_B = 1.0 / about_point
    cases = {
        "base.mass": (length**2, g * length),
        # The centre of mass is above the origin, and nearer to the point.
        "base.com.z": (-2.0 * mass * length, -mass * g),
        "base.inertia.xx": (None, 0.0),
    }
    for name, (by_inertia, by_weight) in cases.items():
        dI = np.array((1.0, 0.0, 0.0))
        if by_inertia is not None:
            dI = by_inertia * np.array((1.0, 1.0, 0.0))
        one = S[name]
        dA = -2.0 * by_weight / about_point[:2] - of_A * dI[:2] / about_point[:2]
        dB = -of_B * dI / about_point
        np.testing.assert_allclose(np.diag(one.dA[3:, :3])[:2], dA, atol=1e-12)
        np.testing.assert_allclose(np.diag(one.dB[3:, :3]), dB, atol=1e-12)
        assert np.abs(one.df0).max() < 1e-12


def test_the_weight_of_a_clamped_body_is_the_derivative_of_its_force():
    build = Build(pin.Inertia(4.0, np.array((0.2, 0.0, 0.0)), np.eye(3)))
    robot = build.robot(
        "clamped",
        gravity=(0.0, 0.0, -10.0),
        constraints=[fflin.Weld("base", name="clamp", placement=at())],
        outputs=[fflin.ConstraintForce("clamp")],
    )
    S = fflin.sensitivity(fflin.linearize(robot))
    by_mass, by_shift = S["base.mass"].dy0, S["base.com.y"].dy0
    np.testing.assert_allclose(by_mass, [0, 0, 10.0, 0, -2.0, 0], atol=1e-12)
    np.testing.assert_allclose(by_shift, [0, 0, 0, 40.0, 0, 0], atol=1e-12)
    assert S["base.mass"].dA.shape == (0, 0)
    assert S.check(["base.mass"]) == {"base.mass": 0.0}


@pytest.mark.parametrize("ratio", [0.5, 0.999, 1.001])
def test_a_strut_under_load_has_the_derivatives_of_its_closed_form(ratio):
    """A[1, 0] = -2 (2 k - P L) / I, with I = 2 m L^2 / 3, for two rods and the load P."""
    mass, length, stiffness = 1.2, 0.9, 40.0
    load = ratio * 2.0 * stiffness / length
    robot = strut(mass, length, stiffness)
    u = fflin.effort(robot, {"slide": load})
    lin = fflin.linearize(robot, u=u, independent=["knee"])
    S = fflin.sensitivity(lin)
    inertia = 2.0 * mass * length**2 / 3.0
    scale = 4.0 * stiffness / inertia
    by_stiffness = S["knee.stiffness"].dA
    np.testing.assert_allclose(by_stiffness, [[0, 0], [-4.0 / inertia, 0]], atol=1e-9)
    # Each rod has half of the inertia. The load in the strut does not depend on it.
    A = -2.0 * (2.0 * stiffness - load * length) / inertia
    for name in ("base.density", "knee.density"):
        assert abs(S[name].dA[1, 0] + 0.5 * A) < 1e-9 * scale
    # The slider does not move to first order.
    assert np.abs(S["slide.mass"].dA).max() < 1e-9 * scale


def test_a_parallelogram_swings_as_its_coupler_says():
    """w^2 = g (m_c + m) l / (2 m l^2 / 3 + m_c l^2) with cranks m and coupler m_c."""
    crank, coupler, length, g = 1.5, 2.5, 0.4, 9.81
    robot = parallelogram(crank, coupler, length, 0.6)
    lin = fflin.linearize(robot, independent=["left"])
    S = fflin.sensitivity(lin)
    stiffness = g * length * (coupler + crank)
    inertia = 2.0 * crank * length**2 / 3.0 + coupler * length**2
    assert lin.A[1, 0] == pytest.approx(-stiffness / inertia, rel=1e-9)
    # The name of a link is the name of its joint.
    by_mass = S["bar.mass"]
    expected = -g * length / inertia + stiffness * length**2 / inertia**2
    assert by_mass.dA[1, 0] == pytest.approx(expected, rel=1e-9)
    column = lin.input_names.index("tau_m.left")
    assert by_mass.dB[1, column] == pytest.approx(-((length / inertia) ** 2), rel=1e-9)
    # The coupler does not rotate, so only its mass has an effect.
    for name in ("bar.com.x", "bar.com.y", "bar.inertia.zz"):
        assert np.abs(S[name].dA).max() < 1e-9


# --- differences of changed robots


@pytest.mark.parametrize(
    ("seed", "options"),
    [
        (0, {"frame": "local"}),
        *exhaustive(
            (1, {"frame": "hybrid"}),
            (2, {"frame": "world"}),
            (3, {"moving": True}),
            (7, {"frame": "hybrid"}),
        ),
    ],
)
def test_loads_and_motions_have_the_derivatives_of_differences(seed, options):
    rng = np.random.default_rng(seed)
    robot, q, v, u = random_constraints(rng, count=1 + seed % 3, joints=4)
    robot = robot.replace(outputs=[fflin.FullState(), fflin.Accelerometer("joint_2")])
    if "frame" in options:
        options = {**options, "reference": random_pose(rng, 50.0)}
    lin = fflin.linearize(robot, q, v, u, **options)

    def relinearised(other):
        return fflin.linearize(other, q, v, u, independent=lin.independent, **options)

    errors = body_errors(lin, relinearised, rng, 4)
    assert max(errors.values()) < DIFFERENCES, errors
    checked = fflin.sensitivity(lin).check([*errors])
    assert max(checked.values()) < 1e-6, checked


@pytest.mark.exhaustive
@pytest.mark.parametrize("first", range(0, 200, 100))
def test_random_robots_have_the_derivatives_of_differences(first):
    """Every fifth of 200 random robots with constraints, at rest or in motion."""
    for seed in range(first, first + 100, 5):
        rng = np.random.default_rng([47, seed])
        try:
            robot, q, v, u = random_constraints(
                rng, count=1 + seed % 3, loads=seed % 2 == 0
            )
            if seed % 3 == 0:
                v, u = np.zeros_like(v), np.zeros_like(u)
            lin = fflin.linearize(robot, q, v, u, frame=FRAMES[seed % 3])
        except fflin.ConstraintError:
            continue  # a singular posture, or constraints without effect

        def relinearised(other, lin=lin, q=q, v=v, u=u):
            return fflin.linearize(
                other, q, v, u, frame=lin.frame, independent=lin.independent
            )

        errors = body_errors(lin, relinearised, rng, 2)
        assert max(errors.values()) < 1e-6, (seed, errors)


@pytest.mark.exhaustive
@pytest.mark.parametrize("make", [in_orbit, flexible, with_wheels, mimicking])
def test_robots_of_every_kind_have_the_derivatives_of_differences(make, tmp_path):
    rng = np.random.default_rng(5)
    robot, q, v, u = moving(make, tmp_path, rng)
    lin = fflin.linearize(robot, q, v, u)

    def relinearised(other):
        return fflin.linearize(other, q, v, u, independent=lin.independent)

    errors = body_errors(lin, relinearised, rng, 8)
    assert max(errors.values()) < DIFFERENCES, errors


def held_panels():
    """A satellite with panels on springs out of their rest, held at a point."""
    return fflin.load(
        "servicer_7dof",
        constraints=[fflin.Spherical("tool")],
        stiffness={"panel_*": 80.0},
        damping={"panel_*": 3.0},
        rest={"panel_left": 0.2},
    )


@pytest.mark.parametrize("name", ["panel_left.stiffness", "panel_right.damping"])
def test_springs_and_dampers_have_the_derivatives_of_differences(name):
    robot = held_panels()
    rng = np.random.default_rng(3)
    nu = 0.1 * rng.normal(size=6 + robot.n)
    start = fflin.configuration(robot, {"panel_right": 0.1})
    q, v = fflin.closed(robot, start, fflin.StateMap(robot).spread(nu))
    lin = fflin.linearize(robot, q, v)
    S = fflin.sensitivity(lin)
    joint, kind = name.split(".")

    def source(size):
        values = {**getattr(robot, kind)}
        values[joint] += size
        other = robot.replace(**{kind: values})
        return fflin.linearize(other, q, v, independent=lin.independent)

    assert apart_from_differences(lin, name, source, 0.5, S) < 1e-9


def test_a_thruster_on_a_loop_has_the_derivatives_of_differences():
    robot = with_wheels()
    rng = np.random.default_rng(2)
    q = fflin.closed(robot, robot.neutral())
    u = rng.normal(size=len(fflin.linearize(robot, q).u0))
    lin = fflin.linearize(robot, q, u=u)
    S = fflin.sensitivity(lin)
    index = next(
        index
        for index, item in enumerate(robot.inputs)
        if isinstance(item, fflin.Thruster)
    )
    item = robot.inputs[index]
    name = next(x for x in S.names if x.endswith("position.x"))

    def source(size):
        inputs = list(robot.inputs)
        inputs[index] = replace(item, position=np.add(item.position, (size, 0, 0)))
        other = robot.replace(inputs=inputs)
        return fflin.linearize(other, q, u=u, independent=lin.independent)

    assert apart_from_differences(lin, name, source, 1e-2, S) < 1e-9


@pytest.mark.exhaustive
def test_forces_of_constraints_have_the_derivatives_of_differences():
    rng = np.random.default_rng(6)
    robot, q, v, u = random_constraints(rng, count=1, joints=9)
    held = [fflin.Hinge("joint_2", name="pin"), fflin.Spherical("joint_8", name="arm")]
    robot = robot.replace(
        constraints=held,
        outputs=[fflin.ConstraintForce("pin"), fflin.ConstraintForce("arm")],
    )
    q, v = fflin.closed(robot, q, v)
    lin = fflin.linearize(robot, q, v, u, reference=random_pose(rng, 30.0))
    assert np.abs(lin.y0).max() > 0.1

    def relinearised(other):
        options = {"reference": lin.reference, "independent": lin.independent}
        return fflin.linearize(other, q, v, u, **options)

    errors = body_errors(lin, relinearised, rng, 8)
    assert max(errors.values()) < DIFFERENCES, errors


def test_sampled_and_lagging_models_have_derivatives():
    """They follow from the derivatives in continuous time."""
    held = [fflin.Hinge("base", axis=(0, 0, 1))]
    inputs = [fflin.BaseTorque(lag=0.4), fflin.JointTorque("*")]
    robot = fflin.load("planar_detumble", constraints=held, inputs=inputs)
    q = fflin.configuration(robot, {"joint_2": 0.4})
    name = "hand.mass"

    def model(other):
        lin = fflin.linearize(other, q, independent=["q_b.z", "joint_*"])
        return lin.with_lags().discretize(0.2)

    lin = model(robot)
    S = fflin.sensitivity(lin)
    bodies = S.parameters[name].bodies

    def source(size):
        return model(changed(robot, bodies, size))

    step = 0.02 * S.parameters[name].value
    assert apart_from_differences(lin, name, source, step, S) < 1e-8
    poles, derivatives = fflin.sensitivity(fflin.linearize(robot, q)).poles()
    assert derivatives.shape[1] == len(poles) == 2 * (6 + robot.n - 5)


def test_the_check_finds_a_wrong_derivative():
    robot = held_panels()
    lin = fflin.linearize(robot, fflin.closed(robot, robot.neutral()))
    S = fflin.sensitivity(lin)
    assert S.check(["base.mass"])["base.mass"] < 1e-8
    wrong = fflin.sensitivity(lin)
    wrong._derivatives._held.response[2] *= 1.001
    assert wrong.check(["base.mass"])["base.mass"] > 1e-5


def test_the_check_refuses_constraints_with_mimic_joints(tmp_path):
    robot = mimicking(tmp_path)
    S = fflin.sensitivity(fflin.linearize(robot))
    with pytest.raises(fflin.InputError, match="do not support mimic joints"):
        S.check([next(iter(S.names))])


def test_the_table_ranks_the_parameters_of_a_loop():
    robot = parallelogram(1.0, 2.0, 0.3, 0.5)
    text = fflin.sensitivity(fflin.linearize(robot)).table(top=5)
    assert text.startswith("parallelogram: bar.mass changes A and B most")
