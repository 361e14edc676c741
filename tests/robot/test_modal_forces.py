"""Forces of modes in motion: exact for a straight beam, and independent of the rest of the link."""

import math

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.state import StateMap
from fflin.robot.equipment.assembly import mounted_modes
from tests.robot.test_appendages import (
    beam,
    clamped_roots,
    displaced,
    hub_with_rod,
    servicer,
)

EPS = float(np.finfo(float).eps)
HUB_INERTIA, ROD, LENGTH, STIFFNESS, MODES = 1.0, 5.0, 4.0, 30.0, 3


class Beam:
    """Uniform cantilever along x of a free hub, which bends along z: its own Lagrangian.

    The beam is a sum of point masses at Gauss points. A point at x has the position
    p = x e_x + sum_j phi_j(x) eta_j e_z, with the clamped modes phi_j of unit modal mass. Its
    velocity in base axes is v + omega x p + dp/dt.
    """

    def __init__(self, hub_mass):
        nodes, weights = np.polynomial.legendre.leggauss(60)
        self.x, self.mass = 0.5 * LENGTH * (nodes + 1.0), 0.5 * ROD * weights
        b = clamped_roots(MODES)
        sigma = (np.sinh(b) - np.sin(b)) / (np.cosh(b) + np.cos(b))
        at = np.outer(self.x / LENGTH, b)
        self.phi = np.cosh(at) - np.cos(at) - sigma * (np.sinh(at) - np.sin(at))
        self.phi /= math.sqrt(ROD)
        self.stiffness = b**4 * STIFFNESS / (ROD * LENGTH**3)
        self.hub = (
            hub_mass,
            HUB_INERTIA * np.eye(3) + ROD * LENGTH**2 / 12.0 * np.diag([0.02, 0, 0]),
        )

    def accelerations(self, v, omega, eta, etadot):
        """d omega/dt, d v/dt and d^2 eta/dt^2 (6 + k,) without inputs, in base axes."""
        hub_mass, hub_inertia = self.hub
        n = 6 + MODES
        M, h = np.zeros((n, n)), np.zeros(n)
        M[:3, :3], M[3:6, 3:6] = hub_inertia, hub_mass * np.eye(3)
        h[:3] = np.cross(omega, hub_inertia @ omega)
        h[3:6] = hub_mass * np.cross(omega, v)
        h[6:] = self.stiffness * eta
        for x, mass, phi in zip(self.x, self.mass, self.phi, strict=True):
            p, pdot = np.array([x, 0.0, phi @ eta]), np.array([0.0, 0.0, phi @ etadot])
            along = np.zeros((3, MODES))
            along[2] = phi
            J = np.hstack((-pin.skew(p), np.eye(3), along))
            bias = np.cross(omega, v) + 2.0 * np.cross(omega, pdot)
            bias += np.cross(omega, np.cross(omega, p))
            M += mass * J.T @ J
            h += mass * J.T @ bias
        return np.linalg.solve(M, -h)


def beam_robot(hub_mass):
    rigid = hub_with_rod(hub_mass, HUB_INERTIA, ROD, LENGTH)
    return rigid.replace(appendages=[beam(ROD, LENGTH, STIFFNESS, MODES)])


def moving(size, seed=4):
    """Random v, omega, eta and d eta/dt of a hub with a beam; `size` is the scale of eta."""
    rng = np.random.default_rng(seed)
    v, omega, etadot = rng.normal(size=3), rng.normal(size=3), rng.normal(size=MODES)
    return v, omega, size * rng.normal(size=MODES), etadot


def accelerations(robot, v, omega, eta, etadot):
    """f0 [6 + k:] of a hub with modes: its accelerations in base axes."""
    state = StateMap(robot, frame="local")
    x = np.concatenate((np.zeros(6), eta, omega, v, etadot))
    return fflin.linearize(robot, *state.to_pinocchio(x), frame="local").f0[
        6 + len(eta) :
    ]


@pytest.mark.parametrize("hub_mass", [1.0, 30.0, 3e3])
@pytest.mark.parametrize("size", [0.0, 0.4])
def test_a_straight_beam_in_motion_obeys_its_own_lagrangian(hub_mass, size):
    # The balls are outside the radius of gyration of a heavy hub. The ball of a straight beam
    # slides, and has the forces of the beam at all amplitudes.
    rigid = hub_with_rod(hub_mass, HUB_INERTIA, ROD, LENGTH)
    robot = rigid.replace(appendages=[beam(ROD, LENGTH, STIFFNESS, MODES)])
    point = moving(size)
    expected = Beam(hub_mass).accelerations(*point)
    # Sums over 60 points, cosh of 7.9 and the condition of M (up to 1e4) round.
    tolerance = 1e-10 * np.abs(expected).max()
    assert accelerations(robot, *point) == pytest.approx(expected, abs=tolerance)


def test_the_axes_of_link_and_frame_do_not_change_the_forces_of_a_beam():
    hub_mass, clamp = (
        30.0,
        pin.SE3(pin.rpy.rpyToMatrix(0.4, -1.1, 2.0), np.array([0.7, -0.2, 1.3])),
    )
    model = hub_with_rod(hub_mass, HUB_INERTIA, ROD, LENGTH).model.copy()
    model.inertias[1] = clamp.act(model.inertias[1])
    model.addFrame(pin.Frame("clamp", 1, clamp, pin.FrameType.OP_FRAME))
    array = beam(ROD, LENGTH, STIFFNESS, MODES, frame="clamp")
    robot = fflin.from_model(model, name="hub").replace(appendages=[array])
    v, omega, eta, etadot = moving(0.4)
    twist = clamp.act(pin.Motion(v, omega))
    result = accelerations(robot, twist.linear, twist.angular, eta, etadot)
    expected = Beam(hub_mass).accelerations(v, omega, eta, etadot)
    tolerance = 1e-10 * np.abs(expected).max()
    assert result[6:] == pytest.approx(expected[6:], abs=tolerance)
    assert result[:3] == pytest.approx(clamp.rotation @ expected[:3], abs=tolerance)


def general(seed=1, count=4):
    """Rigid servicer, and an array of general modes on its base."""
    rng = np.random.default_rng(seed)
    rigid, _ = servicer()
    t, r = 2.0 * rng.normal(size=(3, count)), 2.0 * rng.normal(size=(3, count))
    t[:, 0] = 0.0  # a torsion
    r[:, 1] = np.cross([1.0, 2.0, 0.5], t[:, 1])  # a straight bend
    t[:, 2] *= 1e-3  # between (16.5) and none
    frequency = np.linspace(0.2, 1.0, count)
    return rigid, fflin.FlexibleAppendage("base", frequency, t, r, name="array")


def heavier(rigid, factor):
    """The rigid robot with another density of its base."""
    body = rigid.model.inertias[1]
    given = {
        "mass": factor * body.mass,
        "com": body.lever,
        "inertia": factor * body.inertia,
    }
    return rigid.with_mass_properties({"base": given})


def test_the_density_of_the_base_changes_no_modal_force():
    rigid, array = general()
    result = []
    for factor in (1.0, 1.7, 40.0):
        robot = heavier(rigid, factor).replace(appendages=[array])
        q, v = displaced(robot, size=0.3)
        a = np.random.default_rng(5).normal(size=robot.nv)
        q_m = dict(zip(robot.joint_names, np.full(robot.n, 0.3), strict=True))
        q = fflin.configuration(robot, q_m)
        modes = [(joint.idx_v, joint.scale) for joint in robot.modes]
        for index, scale in modes:  # the same rates of the amplitudes
            v[index], a[index] = 0.4 * scale, -0.7 * scale
        forces = pin.rnea(robot.model, robot.create_data(), q, v, a)
        result.append([scale * forces[index] for index, scale in modes])
    assert np.abs(result[0]).min() > 1e-3
    # The inertia of the rest of the link does not enter these entries of RNEA.
    assert result[1] == pytest.approx(result[0], abs=1e-12 * np.abs(result[0]).max())
    assert result[2] == pytest.approx(result[0], abs=1e-12 * np.abs(result[0]).max())


@pytest.mark.parametrize("key", ["A", "f0"])
def test_sensitivity_is_the_derivative_of_robots_that_get_their_appendage_anew(key):
    rigid, array = general()
    robot = rigid.replace(appendages=[array])
    state = StateMap(robot)
    x = 0.3 * np.random.default_rng(6).normal(size=state.nx)

    def at(factor):
        other = heavier(rigid, factor).replace(appendages=[array])
        return getattr(fflin.linearize(other, *StateMap(other).to_pinocchio(x)), key)

    h = 1e-2
    far, near = at(1.0 + 2.0 * h) - at(1.0 - 2.0 * h), at(1.0 + h) - at(1.0 - h)
    expected = (8.0 * near - far) / (12.0 * h)
    S = fflin.sensitivity(fflin.linearize(robot, *state.to_pinocchio(x)))
    result = getattr(S["base.density"], f"d{key}")
    # The error of these differences is h^4/30 times the fifth derivative, which is 5! for 1/factor.
    # The rounding errors of `at` are amplified by 1 / h.
    rounding = 1e-13 * np.abs(at(1.0)).max() / h
    tolerance = 4.0 * h**4 * np.abs(expected).max() + rounding
    np.testing.assert_allclose(result, expected, rtol=0, atol=tolerance)
    assert tolerance < 1e-6 * np.abs(expected).max()


def momentum_of(ball):
    """Momentum (6,) of a ball at unit modal rate in the axes of its link, and its modal mass."""
    data = ball.motion.createData()
    ball.motion.calc(data, np.zeros(1))
    S = ball.joint.scale * pin.Motion(np.ravel(data.S))
    momentum = ball.placement.act(ball.inertia * S)
    return momentum.vector, S.dot(
        ball.inertia * S
    ) + ball.armature * ball.joint.scale**2


@pytest.mark.parametrize("count", [30, pytest.param(400, marks=pytest.mark.exhaustive)])
def test_balls_of_columns_of_all_sizes_have_momentum_and_modal_mass(count):
    # Translations and rotations are each from 1e-16 to 1, and five modes make an appendage, so that
    # a mode may be small compared with the others.
    rng, link = np.random.default_rng(8), hub_with_rod(1e3, 1e3, 1.0, 1.0)
    mean_moment = np.trace(link.model.inertias[1].inertia) / 3.0
    for _ in range(count):
        sizes = 10.0 ** rng.uniform(-16.0, 0.0, (2, 1, 5))
        t, r = sizes * rng.normal(size=(2, 3, 5))
        array = fflin.FlexibleAppendage("root_joint", np.ones(5), t, r)
        bodies = [pin.Inertia(body) for body in link.model.inertias.tolist()]
        # Below 1e-12 of its appendage, which is at least 1e-3 of the link, a column is the noise
        # of a structural program and counts as zero.
        scales = np.repeat((link.mass, mean_moment), 3)
        total = np.repeat([np.square(t).sum(), np.square(r).sum()], 3)
        allowed = 1.01e-12 * np.sqrt(np.maximum(total, 1e-6 * scales))
        for ball, column in zip(
            mounted_modes(link.model, bodies, [array]),
            np.vstack((t, r)).T,
            strict=True,
        ):
            momentum, modal_mass = momentum_of(ball)
            assert (np.abs(momentum - column) <= allowed).all()
            assert modal_mass == pytest.approx(1.0, abs=8.0 * EPS)
            # Only a mode that is all noise needs a rotor, and then it has nothing else.
            assert (ball.armature == 1.0) == (not momentum.any())
            assert (ball.armature != 0.0) == (not momentum.any())


@pytest.mark.parametrize("size", [1e-24, 1e-8, 1e-4])
@pytest.mark.parametrize("part", ["translation", "rotation"])
def test_forces_do_not_jump_where_the_choice_of_the_ball_changes(part, size):
    # `size` is the square of the part, compared with the other mode of its appendage.
    rigid = hub_with_rod(30.0, 20.0, ROD, LENGTH)
    t, r = (
        np.array([[0.0, 0.3], [0.0, 0.5], [1.4, 0.2]]),
        np.array([[1.5, 0.4], [2.5, 2.0], [0.3, 1.0]]),
    )

    def at(factor):
        parts = {"translation": t.copy(), "rotation": r.copy()}
        scale = np.square(parts[part][:, 0]).sum()
        column = parts[part][:, 1]
        column *= math.sqrt(factor * size * scale / np.square(column).sum())
        array = fflin.FlexibleAppendage("root_joint", [0.2, 0.5], **parts, name="array")
        v, omega, eta, etadot = moving(0.1)
        robot = rigid.replace(appendages=[array])
        return accelerations(robot, v, omega, eta[:2], etadot[:2])

    before, at_bound, after = at(1.0 - 1e-7), at(1.0), at(1.0 + 1e-7)
    # s jumps by up to 1e-6 before it is 1; noise of 1e-12 counts as zero.
    tolerance = 2e-6 * np.abs(before).max()
    assert at_bound == pytest.approx(before, abs=tolerance)
    assert after == pytest.approx(at_bound, abs=tolerance)


def test_forces_are_continuous_in_the_translation_of_a_rotation():
    # Noise has an effect of its own size, and from a rotation to a translation no step is large.
    rigid, result, sizes = (
        hub_with_rod(30.0, 20.0, ROD, LENGTH),
        [],
        np.logspace(-14.0, -1.0, 27),
    )
    v, omega, eta, etadot = moving(0.1)
    for size in sizes:
        t, r = size * np.array([[0.3], [0.2], [1.0]]), [[1.5], [2.5], [0.3]]
        array = fflin.FlexibleAppendage("root_joint", 0.3, t, r)
        robot = rigid.replace(appendages=[array])
        result.append(accelerations(robot, v, omega, eta[:1], etadot[:1]))
    change = np.abs(np.array(result) - result[0]).max(axis=1) / np.abs(result[0]).max()
    assert (change[sizes < 2e-7] < sizes[sizes < 2e-7]).all()
    # About 5 of 26 steps are between a rotation and a translation. A jump would be one of them.
    assert np.abs(np.diff(change)).max() < 0.6 * np.ptp(change)


def array_on_a_drive(noise=0.0, seed=0):
    """Satellite whose array turns on a drive: two modes of a beam with noise in its table."""
    array = beam(12.0, 2.1, 1.0, 2)
    rng = np.random.default_rng(seed)
    t = array.translation + noise * rng.normal(size=(3, 2))
    r = array.rotation + noise * rng.normal(size=(3, 2))
    model = pin.Model()
    base = model.addJoint(
        0, pin.JointModelFreeFlyer(), pin.SE3.Identity(), "root_joint"
    )
    model.appendBodyToJoint(
        base,
        pin.Inertia(200.0, np.zeros(3), np.diag([50.0, 40.0, 45.0])),
        pin.SE3.Identity(),
    )
    drive = pin.SE3(np.eye(3), np.array([0.6, 0.0, 0.0]))
    joint = model.addJoint(base, pin.JointModelRX(), drive, "drive")
    rod = pin.Inertia(12.0, np.array([1.05, 0.0, 0.02]), np.diag([0.05, 4.41, 4.45]))
    model.appendBodyToJoint(joint, rod, pin.SE3.Identity())
    for index in (base, joint):
        model.addJointFrame(index)
    flexible = fflin.FlexibleAppendage("drive", [0.25, 1.567], t, r, name="array")
    return fflin.from_model(model, name="sat"), flexible


def test_noise_in_place_of_zero_changes_a_model_by_noise():
    rigid, exact = array_on_a_drive()
    robot = rigid.replace(appendages=[exact])
    x = 0.2 * np.random.default_rng(3).normal(size=2 * (6 + robot.n))

    def at(appendage):
        other = rigid.replace(appendages=[appendage])
        return fflin.linearize(other, *StateMap(other).to_pinocchio(x))

    expected = at(exact)
    for noise in (1e-16, 1e-14, 1e-13, 1e-12, 1e-10):
        for seed in range(3):
            result = at(array_on_a_drive(noise, seed)[1])
            for key in ("A", "B", "f0"):
                ours, theirs = getattr(expected, key), getattr(result, key)
                assert (
                    np.abs(ours - theirs).max()
                    <= (1e2 * noise + 1e-12) * np.abs(ours).max()
                )


def test_energies_of_links_include_their_modes():
    rigid, array = array_on_a_drive()
    # A third mode without participation, whose energy is only its own.
    t, r = (
        np.column_stack((x, np.zeros(3))) for x in (array.translation, array.rotation)
    )
    array = fflin.FlexibleAppendage("drive", [0.25, 1.567, 0.8], t, r, name="array")
    robot = rigid.replace(
        appendages=[array], stiffness={"drive": 30.0}, rest={"drive": 0.7}
    )
    q = fflin.configuration(robot, {"drive": 0.7})
    result = fflin.modes(fflin.linearize(robot, q, frame="local"))
    state = StateMap(robot, frame="local")
    assert len(result.vibrations) == 4
    for mode in result.vibrations:
        assert set(mode.energy) == {"base", "drive"}
        assert min(mode.energy.values()) >= 0.0
        assert sum(mode.energy.values()) == pytest.approx(1.0, abs=1e-12)
        # (16.1) of the array, and the energy of a rigid base.
        energies = np.zeros(2)
        half = len(mode.shape) // 2
        nu = mode.shape[:half].copy()
        nu[:3] *= 2.0  # the rate of q_b is half the angular velocity
        for part in (nu.real, nu.imag):
            data, v = rigid.create_data(), state.spread(part)[: rigid.nv]
            pin.forwardKinematics(rigid.model, data, q[: rigid.nq], v)
            base, link = data.v[1], data.v[2]
            etadot = part[-3:]
            momentum = link.vector @ np.vstack((t, r)) @ etadot
            energies[0] += rigid.model.inertias[1].vtiv(base)
            energies[1] += (
                rigid.model.inertias[2].vtiv(link) + 2.0 * momentum + etadot @ etadot
            )
        expected = energies / energies.sum()
        assert mode.energy["base"] == pytest.approx(expected[0], abs=1e-10)
        assert mode.energy["drive"] == pytest.approx(expected[1], abs=1e-10)


def test_a_mode_with_the_whole_mass_of_a_free_link_is_refused():
    # All mass of the link along z is in the mode: the link moves against it without momentum.
    rigid = hub_with_rod(1.0, 1.0, 1.0, 1.0)
    com = rigid.model.inertias[1].lever
    t = np.array([[0.0], [0.0], [math.sqrt(rigid.mass)]])
    r = np.cross(com, t[:, 0])[:, None]
    robot = rigid.replace(
        appendages=[fflin.FlexibleAppendage("root_joint", 0.3, t, r, name="all")]
    )
    with pytest.raises(
        fflin.SingularInertiaError, match=r"'all_mode_1'.*give the link more inertia"
    ):
        fflin.linearize(robot)
    part = fflin.FlexibleAppendage("root_joint", 0.3, 0.999 * t, 0.999 * r, name="part")
    assert fflin.linearize(rigid.replace(appendages=[part])).certificate.route_A < 1e-10
    # On a link that moves another body with it, the same mode is fine.
    carried, _ = array_on_a_drive()
    com, mass = carried.model.inertias[2].lever, 12.0
    t = np.array([[0.0], [0.0], [math.sqrt(mass)]])
    all_of_it = fflin.FlexibleAppendage(
        "drive", 0.3, t, np.cross(com, t[:, 0])[:, None], name="all"
    )
    robot = carried.replace(appendages=[all_of_it])
    assert fflin.check(robot, fflin.linearize(robot)).ok
    # The mode that moves like the whole array on its drive takes all inertia about the drive.
    body = carried.model.inertias[2].matrix()
    column = body[:, 3] / math.sqrt(body[3, 3])
    spins = fflin.FlexibleAppendage(
        "drive", 0.3, column[:3, None], column[3:, None], name="spins"
    )
    with pytest.raises(
        fflin.SingularInertiaError, match="joint 'drive', joint 'spins_mode_1' can"
    ):
        fflin.linearize(carried.replace(appendages=[spins]))
