"""C code of BDot and RateDamping, and of a periodic regulator, equals the laws in Python."""

import numpy as np
import pytest

import fflin
from fflin.control.bdot import measured_field
from fflin.export.c_code import CLaw
from tests.support.c_code import COMPILERS, needs_compiler, outcome

pytestmark = [pytest.mark.process, needs_compiler]

LAWS = {"BDot": fflin.BDot(3e4), "RateDamping": fflin.RateDamping(3e-5)}
SAMPLES = 2_000
LIMIT = 0.05  # [A m^2]


@pytest.fixture(scope="module")
def satellite():
    orbit = fflin.EllipticOrbit(
        perigee=500e3, eccentricity=0.1, inclination=1.2, field="tilted_dipole"
    )
    axes = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 2.0, -2.0))
    rods = [fflin.Magnetorquer(axis, max=LIMIT) for axis in axes]
    return fflin.load("cubesat", orbit=orbit, inputs=rods)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", LAWS)
def test_the_code_equals_python_over_two_thousand_samples(kind, satellite, tmp_path):
    law = LAWS[kind]
    folder = fflin.write_c(law, tmp_path, robot=satellite, limits="urdf")
    for compiler in COMPILERS:
        code, text = outcome(folder, compiler)
        assert code == 0, text
    flown = CLaw(folder)
    code, command = flown.bind(satellite), law.bind(satellite)
    random = np.random.default_rng(5)
    limited = 0
    for k in range(SAMPLES):
        q = satellite.neutral()
        q[3:7] = random.normal(size=4)
        q[3:7] /= np.linalg.norm(q[3:7])
        v = np.r_[np.zeros(3), random.normal(scale=0.1, size=3)]
        expected = np.clip(command(3.0 * k, q, v), -LIMIT, LIMIT)
        limited += (np.abs(expected) == LIMIT).any()
        assert np.abs(code(3.0 * k, q, v) - expected).max() < 1e-12 * LIMIT
    assert 100 < limited < SAMPLES - 100


@pytest.mark.parametrize("kind", LAWS)
def test_a_sampled_motion_with_the_code_is_the_motion_without(
    kind, satellite, tmp_path
):
    law = LAWS[kind]
    flown = CLaw(fflin.write_c(law, tmp_path, robot=satellite, limits="urdf"))
    v0 = fflin.velocity(satellite, {"omega_b": 0.05})
    options = {"v0": v0, "dt": 2.0, "sample": 4.0, "duration": 40.0}
    one, other = (
        fflin.simulate(satellite, item, limits="urdf", **options)
        for item in (flown, law)
    )
    assert (np.abs(other.u) == LIMIT).any() and (np.abs(other.u) < LIMIT).any()
    assert np.abs(one.u - other.u).max() < 1e-12
    assert np.abs(one.q - other.q).max() < 1e-12


def test_single_precision(satellite, tmp_path):
    law = LAWS["RateDamping"]
    folder = fflin.write_c(law, tmp_path, robot=satellite, real="float")
    for compiler in COMPILERS:
        code, text = outcome(folder, compiler)
        assert code == 0, text


def test_invalid_measurements_give_zero_moments(satellite, tmp_path):
    flown = CLaw(fflin.write_c(LAWS["BDot"], tmp_path, robot=satellite))
    u = np.ones(3)
    y = np.array([np.nan, 0.0, 0.0])
    assert flown._step(y.ctypes, u.ctypes) == 2
    assert not u.any()


def test_the_header_names_the_measurements_and_the_inputs(satellite, tmp_path):
    for kind, law in LAWS.items():
        folder = fflin.write_c(law, tmp_path, robot=satellite, name=kind)
        header = (folder / f"{kind}.h").read_text()
        assert "u[2]  magnetorquer_3 [A m^2]" in header
        expected = "y[3]  omega.x [rad/s]"
        if kind == "BDot":
            expected = "y[0]  derivative of b.x [T/s]"
        assert expected in header
    # The measured vectors of the law that is flown.
    measure = measured_field(satellite, rate=True)
    b, omega = np.split(measure(0.0, satellite.neutral(), np.zeros(6)), 2)
    assert 1e-5 < np.linalg.norm(b) < 6e-5
    rate = satellite.orbit.at(0.0).rate
    assert np.linalg.norm(omega) == pytest.approx(rate, rel=1e-12)


def test_the_robot_must_be_given_and_must_have_magnetorquers(satellite, tmp_path):
    with pytest.raises(fflin.InputError, match="robot of this BDot is not known"):
        fflin.write_c(LAWS["BDot"], tmp_path)
    plain = fflin.load("cubesat", orbit=500e3)
    with pytest.raises(fflin.InputError, match="no magnetorquers for this law"):
        fflin.write_c(LAWS["BDot"], tmp_path, robot=plain)
    code = CLaw(fflin.write_c(LAWS["BDot"], tmp_path, robot=satellite))
    fewer = satellite.replace(inputs=satellite.inputs[:2])
    with pytest.raises(fflin.InputError, match="C code 'controller' was made from"):
        fflin.simulate(fewer, code, duration=10.0)


@pytest.mark.exhaustive
def test_a_periodic_regulator_repeats_in_the_code(tmp_path):
    """Two thousand samples are more than 60 periods of 32 samples."""
    orbit = fflin.CircularOrbit(500e3, inclination=1.2, field="dipole")
    rods = [fflin.Magnetorquer(axis, max=LIMIT) for axis in np.eye(3)]
    robot = fflin.load("cubesat", orbit=orbit, inputs=rods)
    models = fflin.linearize_orbit(robot, steps=16)
    h = orbit.period / 32
    schedule = fflin.tvlqr(models, 1.0, 1e4, "periodic", sample=h)
    least = 2e-4  # [A m^2]
    folder = fflin.write_c(schedule, tmp_path, robot=robot, limits=least)
    for compiler in COMPILERS:
        code, text = outcome(folder, compiler)
        assert code == 0, text
    law = fflin.TrajectoryFeedback(models, schedule)
    code, command = CLaw(folder).bind(robot), law.bind(robot)
    random = np.random.default_rng(5)
    limited = 0
    for k in range(SAMPLES):
        q = models.q[0].copy()
        q[3:7] += random.normal(scale=0.02, size=4)
        q[3:7] /= np.linalg.norm(q[3:7])
        v = random.normal(scale=1e-4, size=6)
        expected = np.clip(command(k * h, q, v), -least, least)
        limited += (np.abs(expected) == least).any()
        assert np.abs(code(k * h, q, v) - expected).max() < 1e-12 * least
    assert 100 < limited < SAMPLES - 100
