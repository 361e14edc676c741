"""The kernel in orbit, uncompiled, agrees with Pinocchio's mechanics in the orbital frame."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.kernel import derivatives, orbit
from fflin.simulation.lanes import orbit_of
from fflin.simulation.run import go
from tests.kernel.test_advance import advanced, planned
from tests.support.marks import exhaustive
from tests.support.orbits import N, in_orbit
from tests.support.policies import between_gains, outputs, plain, shared, state
from tests.support.robots import LINKS, MIMIC, random_point, random_tree

# Both engines round differently in each of at most 40 steps, by some machine epsilons relative to
# the largest entry. The Jacobi integral is a sum of larger terms that cancel.
TOLERANCE = 1e-12


def agree(plan, tolerance=TOLERANCE):
    plan = plan.replace(times=plan.times._replace(every=1))
    expected = go(plan)
    values = dict(zip(("q", "v", "u", "momentum"), advanced(plan), strict=False))
    for name, value in values.items():
        other = getattr(expected, name)
        size = np.maximum(1.0, np.abs(other).max(axis=0, initial=0.0))
        assert (np.abs(value - other) <= tolerance * size).all(), name
    return expected


def tree(n, seed):
    return random_tree(np.random.default_rng(seed), n)


def moving(robot, seed=3):
    """The robot in orbit, with a random point of fast motion away from the frame's origin."""
    q, v, _ = random_point(robot, np.random.default_rng(seed), speed=0.3, degrees=40.0)
    q[:3] += [4.0, -7.0, 2.0]
    return in_orbit(robot), {"q0": q, "v0": v, "dt": 0.02, "duration": 0.12}


@pytest.mark.parametrize("frame", ["hill", "lvlh"])
@pytest.mark.parametrize("name", ["cubesat", *exhaustive("planar_detumble", "ets_vii")])
def test_a_free_motion_matches_pinocchio(robots, name, frame):
    robot, options = moving(robots[name])
    agree(planned(robot, frame=frame, **options))


@pytest.mark.parametrize("seed", [1, *exhaustive(2, 3, 4)])
def test_springs_dampers_and_every_joint_type_match_pinocchio(seed):
    robot, options = moving(tree(4, seed).replace(stiffness=2.0, damping=0.5))
    run = agree(planned(robot, **options))
    assert np.ptp(run.momentum[:, 0]) > 1e-3  # the work of the dampers


def mimic(path):
    """A robot with a mimic joint, and with rotors."""
    followed = '<mimic joint="b" multiplier="-2" offset="0.3"/>'
    types = {"a": "prismatic", "b": "continuous"}
    document = MIMIC.format(links=LINKS, parent="la", mimic=followed, **types)
    (path / "r.urdf").write_text(document)
    robot = fflin.load(path / "r.urdf")
    model = robot.model.copy()
    model.armature = np.r_[np.zeros(6), np.linspace(0.1, 2.0, model.nv - 6)]
    return replace(robot, model=model)


def test_mimic_joints_and_rotors_match_pinocchio(tmp_path):
    robot, options = moving(mimic(tmp_path))
    agree(planned(robot, **options))


def test_stored_momentum_matches_pinocchio(robots):
    wheel = fflin.ReactionWheel([1.0, 2.0, -1.0], momentum=0.02)
    robot, options = moving(robots["cubesat"].replace(inputs=[wheel]))
    agree(planned(robot, **options))


def test_disturbances_in_all_axes_match_pinocchio(robots):
    inertial = {"amplitude": [0.1, 0.2, -0.1], "frequency": 0.7, "axes": "inertial"}
    robot, options = moving(robots["cubesat"])
    robot = robot.replace(
        disturbance={
            "tau_b": [{"constant": [1e-3, 0.0, 2e-3]}, inertial],
            "F_b": [
                {"constant": [0.1, 0.2, 0.3], "axes": "inertial"},
                {"constant": [0.3, 0.0, 0.1], "axes": "orbital"},
            ],
        }
    )
    agree(planned(robot, **options))


@pytest.mark.parametrize("make", [state, *exhaustive(outputs, between_gains, shared)])
def test_every_kind_of_law_matches_pinocchio(robots, make):
    robot, policy, options = make(in_orbit(plain(robots["planar_detumble"])))
    q0 = fflin.configuration(robot, rpy=(8, -5, 12))
    options = {"q0": q0, "dt": 0.02, "duration": 0.1} | options
    run = agree(planned(robot, policy, **options))
    assert np.abs(run.u).max() > 1e-3


def test_the_frame_turns_a_constant_inertial_vector_back(robots):
    plan = planned(in_orbit(robots["cubesat"]), frame="hill", duration=1.0)
    values = orbit_of(plan.plant)
    values = values._replace(mean_motion=np.array(values.mean_motion))
    orbit.write_now(values, 0.7)
    expected = pin.exp3(np.array([0.0, 0.0, -0.7 * N])) @ [1.0, 2.0, 3.0]
    result = orbit.from_inertial_axes(values, (1.0, 2.0, 3.0))
    assert result == pytest.approx(tuple(expected), rel=1e-15)


def with_torquers(robot, law=None):
    """The robot with magnetorquers on the base and on its last link, in a strong field."""
    frames = ["base", *robot.joint_names[-1:]]
    rods = [fflin.Magnetorquer([1.0, 2.0, -1.0], frame, max=50.0) for frame in frames]
    orbit = fflin.CircularOrbit(
        mean_motion=N,
        mu=N**2 * 1e18,
        body_radius=1.0,
        inclination=0.9,
        argument_of_latitude=0.4,
        field="dipole",
    )
    return robot.replace(orbit=orbit, inputs=[*rods, fflin.BaseTorque()])


def test_magnetorquers_match_pinocchio(robots):
    _, options = moving(robots["planar_detumble"])
    robot = with_torquers(robots["planar_detumble"])
    lin = fflin.linearize(robot)
    K = np.zeros((5, len(lin.x0)))
    K[:2, 8:11] = [[200.0, -100.0, 300.0], [100.0, 200.0, -200.0]]
    law = fflin.StateFeedback(lin, K)
    limits = {f"magnetorquer_{k}": (-50.0, 50.0) for k in (1, 2)}
    run = agree(planned(robot, law, limits=limits, **options))
    assert np.abs(run.u[:, :2]).max() == 50.0
    free = go(planned(robot, **options))
    assert np.abs(free.v - run.v).max() > 1e-6


@pytest.mark.parametrize("sample", [None, 0.04])
def test_the_b_dot_law_matches_the_python_engine(robots, sample):
    _, options = moving(robots["cubesat"])
    robot = with_torquers(robots["cubesat"])
    run = agree(planned(robot, fflin.BDot(300.0), sample=sample, **options))
    assert np.abs(run.u[:, 0]).max() > 0.1


@pytest.mark.parametrize("field", ["dipole", "tilted_dipole"])
@pytest.mark.parametrize("eccentricity", [None, 0.3])
def test_the_magnetic_field_matches_the_python_engine(robots, eccentricity, field):
    """The angular velocity of the earth and of the orbit are similar, so that each is seen."""
    options = {"inclination": 0.9, "field": field, "node_longitude": 0.4}
    if eccentricity is None:
        options |= {"argument_of_latitude": 0.4}
        path = fflin.CircularOrbit(8000e3, **options)
    else:
        options |= {"argument_of_perigee": -0.5, "anomaly": 2.0}
        path = fflin.EllipticOrbit(perigee=8000e3, eccentricity=0.3, **options)
    for frame in ("lvlh", "hill"):
        plant = planned(
            robots["cubesat"].replace(orbit=path), frame=frame, duration=1.0
        ).plant
        values = orbit_of(plant)
        values = values._replace(mean_motion=np.array(values.mean_motion))
        for t in (0.0, 1e3, 5e4):
            orbit.write_now(values, t)
            for at, expected in (
                (orbit.FLUX, plant.field.magnetic.at(t)),
                (orbit.FLUX_CHANGE, plant.field.magnetic.rate(t)),
            ):
                size = np.abs(expected).max()
                apart = values.now[at : at + 3] - expected
                assert np.abs(apart).max() < TOLERANCE * size


FIELD_ERRORS = {
    "residual_dipole": (20.0, -30.0, 10.0),
    "field_scale": 0.3,
    "field_rotation": (0.2, -0.1, 0.3),
}


@pytest.mark.parametrize("frame", ["lvlh", "hill"])
def test_a_residual_dipole_and_errors_of_the_field_match_pinocchio(robots, frame):
    _, options = moving(robots["planar_detumble"])
    robot = with_torquers(robots["planar_detumble"])
    disturbed = robot.replace(disturbance=FIELD_ERRORS)
    free = go(planned(robot, frame=frame, **options))
    run = agree(planned(disturbed, frame=frame, **options))
    assert np.abs(free.v - run.v).max() > 1e-7
    faults = {"limits": {f"magnetorquer_{k}": (-50.0, 50.0) for k in (1, 2)}}
    lin = fflin.linearize(robot, frame=frame)
    K = np.zeros((5, len(lin.x0)))
    K[:2, 8:11] = 200.0
    law = fflin.StateFeedback(lin, K)
    agree(planned(disturbed, law, frame=frame, **faults, **options))


@pytest.mark.parametrize("law", [fflin.BDot(300.0), fflin.RateDamping(1e-3)])
def test_detumbling_laws_measure_the_true_field(robots, law):
    _, options = moving(robots["cubesat"])
    robot = with_torquers(robots["cubesat"])
    run = agree(planned(robot.replace(disturbance=FIELD_ERRORS), law, **options))
    # At the first instant, the state is the same, and the field is another one.
    model = go(planned(robot, law, **options))
    assert np.abs(run.u[0] - model.u[0]).max() > 0.01 * np.abs(model.u[0]).max()


def test_an_allocation_knows_only_the_model_of_the_field(robots):
    _, options = moving(robots["cubesat"])
    robot = with_torquers(robots["cubesat"])
    rods = [fflin.Magnetorquer(axis, max=50.0) for axis in np.eye(3)]
    robot = robot.replace(inputs=rods)
    design = robots["cubesat"].replace(orbit=robot.orbit, inputs=[fflin.BaseTorque()])
    lin = fflin.linearize(design)
    K = np.zeros((3, 12))
    K[:, 6:9] = 1e-2 * np.eye(3)
    law = fflin.Allocation(fflin.StateFeedback(lin, K), design)
    errors = {name: FIELD_ERRORS[name] for name in ("field_scale", "field_rotation")}
    run = agree(planned(robot.replace(disturbance=errors), law, **options))
    model = go(planned(robot, law, **options))
    assert np.abs(model.u[0]).max() > 1e-3
    assert np.array_equal(run.u[0], model.u[0])
    assert np.abs(run.v - model.v).max() > 1e-9


def test_the_b_dot_law_in_an_ellipse_matches_the_python_engine(robots):
    robot, options = moving(robots["cubesat"])
    path = fflin.EllipticOrbit(
        perigee=1e6,
        eccentricity=0.3,
        anomaly=1.0,
        inclination=0.9,
        field="tilted_dipole",
    )
    rods = [fflin.Magnetorquer([1.0, 2.0, -1.0], max=50.0)]
    robot = robot.replace(orbit=path, inputs=rods)
    run = agree(planned(robot, fflin.BDot(1e5), **options))
    assert np.abs(run.u).max() > 0.1


def swept(robot, monkeypatch, **options):
    """Models of the batch kernel, uncompiled, and models of `linearize`."""
    monkeypatch.setattr(
        derivatives, "kernel", lambda _, name: getattr(derivatives, name)
    )
    monkeypatch.setattr("fflin.batch.sweep.compiles", lambda *_: True)
    rng = np.random.default_rng(5)
    points = [random_point(robot, rng, speed=0.3, degrees=40.0) for _ in range(8)]
    q, v = (
        np.array(rows) for rows in zip(*(point[:2] for point in points), strict=True)
    )
    q[:, :3] += [40.0, -70.0, 20.0]
    return fflin.sweep(robot, q, v, **options), [
        fflin.linearize(robot, q_i, v_i, **options)
        for q_i, v_i in zip(q, v, strict=True)
    ]


@pytest.mark.parametrize("frame", ["hill", *exhaustive("lvlh")])
@pytest.mark.parametrize("seed", [1, *exhaustive(2, 3)])
def test_the_batch_kernel_matches_linearize(monkeypatch, frame, seed):
    robot = in_orbit(tree(3, seed).replace(stiffness=2.0, damping=0.5))
    compare(*swept(robot, monkeypatch, frame=frame))


def test_the_batch_kernel_matches_linearize_with_mimic_joints(monkeypatch, tmp_path):
    compare(*swept(in_orbit(mimic(tmp_path)), monkeypatch))


def compare(batch, models):
    for k, lin in enumerate(models):
        for name in ("A", "B", "f0"):
            expected = getattr(lin, name)
            # A small inertia amplifies rounding errors by the condition number of M.
            limit = TOLERANCE * max(1.0, np.abs(expected).max())
            assert np.abs(getattr(batch, name)[k] - expected).max() < limit, name


def test_the_batch_kernel_leaves_points_far_from_the_frame(monkeypatch, robots):
    robot = robots["cubesat"].replace(orbit=500e3)
    monkeypatch.setattr(
        derivatives, "kernel", lambda _, name: getattr(derivatives, name)
    )
    monkeypatch.setattr("fflin.batch.sweep.compiles", lambda *_: True)
    q = np.tile(robot.neutral(), (8, 1))
    fflin.sweep(robot, q)
    q[3, 0] = 1e5  # 1.5 % of the radius
    with pytest.warns(fflin.FflinWarning, match="linear gravity gradient"):
        fflin.sweep(robot, q)
