"""Derivatives of outputs that weigh the robot themselves, and of sampled models."""

import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import expm

import fflin
from tests.support.complex_crba import motions, spatial
from tests.support.orbits import in_orbit
from tests.support.robots import BUNDLED, random_point, random_pose
from tests.uncertainty.test_sensitivity import H, changed, everything, fourth_order

WEIGHED = [fflin.CenterOfMass(), fflin.FramePose("base"), fflin.Momentum()]


def weighed_by_hand(robot, q, v, bodies):
    """Return centre of mass and momentum about it, from complex dynamic parameters."""
    data, total, first, h = robot.create_data(), 0.0, 0.0, np.zeros(6, complex)
    pin.forwardKinematics(robot.model, data, q)
    for joint, J in motions(robot.model, q).items():
        place, p = data.oMi[joint], bodies[joint]
        total += p[0]
        first += p[0] * place.translation + place.rotation @ p[1:4]
        momentum = spatial(p) @ (J @ v)
        h[3:] += place.rotation @ momentum[:3]
        h[:3] += place.rotation @ momentum[3:] + np.cross(
            place.translation, place.rotation @ momentum[:3]
        )
    h[:3] -= np.cross(first / total, h[3:])
    return np.concatenate((first / total, h))


@pytest.mark.parametrize("name", BUNDLED)
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_centre_of_mass_and_momentum_as_by_complex_steps(name):
    robot = fflin.load(name)
    root = next(f.name for f in robot.model.frames if f.type == pin.FrameType.BODY)
    robot = robot.replace(outputs=[WEIGHED[0], fflin.FramePose(root), WEIGHED[2]])
    q, v, _ = random_point(robot, np.random.default_rng(5), speed=0.5)
    q[:3] = 0.0
    S = fflin.sensitivity(fflin.linearize(robot, q, v, reference=pin.SE3.Identity()))
    bodies = {
        j: robot.model.inertias[j].toDynamicParameters() + 0j
        for j in range(1, robot.model.njoints)
    }
    names = [n for n, one in S.parameters.items() if one.bodies]
    for name in np.random.default_rng(6).choice(
        names, min(12, len(names)), replace=False
    ):
        stepped = dict(bodies)
        for joint, change in S.parameters[name].bodies.items():
            stepped[joint] = bodies[joint] + 1j * H * change
        expected = weighed_by_hand(robot, q, v, stepped).imag / H
        got = S[name].dy0
        size = np.abs(expected).max() + 1e-12
        assert np.abs(got[[0, 1, 2, *range(-6, 0)]] - expected).max() < 1e-10 * size
        assert (
            not got[3:-6].any() and not S[name].dC[3:-6].any() and not S[name].dD.any()
        )


@pytest.mark.parametrize("frame", ["hybrid", "local", "world"])
@pytest.mark.parametrize("name", ["servicer_7dof", "inspector.toml"])
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_their_rows_of_C_as_by_differences(name, frame):
    robot = fflin.load(name)
    robot = robot.replace(outputs=[WEIGHED[2], fflin.Accelerometer("tool"), WEIGHED[0]])
    q, v, _ = random_point(robot, np.random.default_rng(7), degrees=50.0, speed=0.5)
    u, reference = np.zeros(len(fflin.linearize(robot).input_names)), pin.SE3.Random()

    def of(other):
        return fflin.linearize(other, q, v, u, frame=frame, reference=reference)

    S = fflin.sensitivity(of(robot))
    link = "link_3" if name == "servicer_7dof" else "gripper"
    for part in ("mass", "com.y", "inertia.xz", "density"):
        one = S.parameters[f"{link}.{part}"]
        step = 2e-3 / S._derivatives.fraction(one.bodies)
        for at, got in ((2, S[one.name].dC), (5, S[one.name].dy0)):
            expected = fourth_order(
                lambda s, one=one, at=at: everything(of(changed(robot, one.bodies, s)))[
                    at
                ],
                step,
            )
            assert (
                np.abs(got - expected).max() < 1e-7 * np.abs(expected).max() + 1e-9
            ), one.name


@pytest.mark.parametrize("at", ["rest", "sprung", "motion", "moving"])
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_sampled_models_as_by_complex_steps(at):
    robot = fflin.load("servicer_7dof")
    q, v, u = random_point(robot, np.random.default_rng(8), degrees=40.0, speed=0.3)
    if at in ("rest", "sprung"):
        v, u = None, None
    if at == "sprung":
        robot = robot.replace(stiffness={"panel_*": 80.0}, damping={"panel_*": 3.0})
        q = None
    lin = fflin.linearize(robot, q, v, u, moving=at == "moving")
    sampled = lin.discretize(0.1)
    S, D = fflin.sensitivity(lin), fflin.sensitivity(sampled)
    nx, nu = lin.B.shape
    for name in (
        "link_3.mass",
        "base.com.x",
        "panel_left.stiffness",
        "panel_left.damping",
    ):
        block = np.zeros((nx + nu + 1, nx + nu + 1), complex)
        slope, got = S[name], D[name]
        block[:nx] = 1j * H * np.column_stack((slope.dA, slope.dB, slope.df0))
        block[:nx] += np.column_stack((lin.A, lin.B, lin.f0))
        expected = expm(0.1 * block)[:nx].imag / H
        for result, part in (
            (got.dA, expected[:, :nx]),
            (got.dB, expected[:, nx:-1]),
            (got.df0, expected[:, -1]),
        ):
            assert (
                np.abs(result - part).max() <= 1e-10 * np.abs(expected).max() + 1e-300
            ), name
            assert np.abs(result - part).max() <= 1e-8 * np.abs(part).max(), name
    index = list(D.names).index("link_3.mass")
    assert (
        np.abs(D.dB[index] - D["link_3.mass"].dB).max()
        <= 1e-12 * np.abs(D.dB[index]).max()
    )


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_sampled_models_of_other_masses_and_their_poles():
    robot = fflin.load("ets_vii")
    q, v, u = random_point(robot, np.random.default_rng(9), degrees=40.0, speed=0.3)
    sampled = fflin.linearize(robot, q, v, u).discretize(0.2)
    S = fflin.sensitivity(sampled)
    assert S.lin is sampled
    one = S.parameters["link_2.mass"]

    def at(size):
        return fflin.linearize(changed(robot, one.bodies, size), q, v, u).discretize(
            0.2
        )

    slope, step = S["link_2.mass"], 2e-3 / S._derivatives.fraction(one.bodies)
    for part in ("A", "B", "f0"):
        expected = fourth_order(lambda s, part=part: getattr(at(s), part), step)
        assert (
            np.abs(getattr(slope, f"d{part}") - expected).max()
            < 1e-7 * np.abs(expected).max()
        )
    assert max(S.check(["link_2.mass", "base.com.x"]).values()) < 1e-6
    rest = fflin.linearize(robot).discretize(0.2)
    gain = fflin.lqr(rest)
    poles, moved = fflin.sensitivity(rest).poles(gain)

    def poles_at(size):
        other = fflin.linearize(changed(robot, one.bodies, size)).discretize(0.2)
        result = np.linalg.eigvals(other.A - other.B @ gain.K)
        return result[np.abs(result[:, None] - poles).argmin(axis=0)]

    sure = np.isfinite(moved[0])
    assert np.abs(poles).max() < 1.0 and sure.sum() > 10
    expected = fourth_order(poles_at, 1e-3)[sure]
    got = moved[list(S.names).index("link_2.mass")][sure]
    assert np.abs(got - expected).max() < 1e-6 * np.abs(expected).max() + 1e-9


def test_a_sampled_model_whose_source_is_not_known_is_refused(tmp_path):
    sampled = fflin.linearize(fflin.load("cubesat")).discretize(0.1)
    sampled.save(tmp_path / "m.npz")
    with pytest.raises(fflin.InputError, match="file"):
        fflin.sensitivity(fflin.LinearModel.load(tmp_path / "m.npz"))


def test_of_a_link_without_mass_nothing_is_weighed():
    wheel = fflin.ReactionWheel((0.0, 0.0, 1.0), inertia=1e-3, name="w")
    robot = fflin.load("cubesat", inputs=[wheel], outputs=[fflin.Momentum()])
    q = fflin.configuration(robot)
    v = fflin.velocity(robot, {"w": 50.0})
    S = fflin.sensitivity(fflin.linearize(robot, q, v))
    # The wheel's spin is relative to its carrier, which has lost what the wheel has.
    assert S["w.inertia"].dy0 == pytest.approx(
        [0.0, 0.0, 50.0, 0.0, 0.0, 0.0], rel=1e-10
    )


def test_outputs_that_weigh_in_orbit_as_by_differences():
    robot = in_orbit(fflin.load("servicer_7dof")).replace(outputs=WEIGHED[:1])
    rng = np.random.default_rng(10)
    q = fflin.configuration(
        robot, {"joint_2": 0.4, "joint_5": -0.8}, random_pose(rng, 60.0)
    )
    v = 0.2 * rng.normal(size=robot.nv)
    S = fflin.sensitivity(fflin.linearize(robot, q, v, frame="lvlh"))
    for name in ("link_3.mass", "base.com.y"):
        one = S.parameters[name]
        step = 2e-3 / S._derivatives.fraction(one.bodies)
        for at, got in ((2, S[name].dC), (5, S[name].dy0)):

            def of(size, one=one, at=at):
                other = changed(robot, one.bodies, size)
                return everything(fflin.linearize(other, q, v, frame="lvlh"))[at]

            expected = fourth_order(of, step)
            assert np.abs(got - expected).max() < 1e-7 * np.abs(expected).max() + 1e-9
