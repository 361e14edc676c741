"""C code of every kind of law, compared with the policies that simulations use."""

import copy
import errno
import functools
import json
import pickle
import re
import tempfile
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest

import fflin
from fflin.dynamics.state import StateMap
from fflin.export.c_code import _compiled
from fflin.export.laws import measured
from fflin.robot.catalog import find_robot
from tests.support.c_code import COMPILERS, needs_compiler, outcome
from tests.support.marks import exhaustive
from tests.support.messages import any_wording
from tests.support.policies import between_gains, compensated

pytestmark = needs_compiler

POSE = pin.SE3(pin.rpy.rpyToMatrix(1.3, 0.4, -2.0), np.array([0.1, -0.2, 0.3]))


def about(robot, frame="hybrid", dt=0.0):
    """A regulator about a displaced pose, so that the reference is not the world."""
    joints = dict.fromkeys(robot.joint_names[:1], 0.3)
    lin = fflin.linearize(robot, fflin.configuration(robot, joints, POSE), frame=frame)
    lin = lin.discretize(dt) if dt else lin
    return fflin.StateFeedback(lin, fflin.lqr(lin).K)


def tracking():
    robot = fflin.load("planar_detumble")
    v0 = fflin.velocity(robot, {"joint_1": 0.1, "omega_b.z": 0.2})
    motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
    along = fflin.linearize_trajectory(robot, motion.trajectory())
    return robot, along, fflin.tvlqr(along, sample=0.1)


def mixed():
    """A compensator with a direct term, and outputs among which are continuous joints."""
    robot, lin, controller = compensated(
        fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
    )
    D = np.random.default_rng(1).normal(size=lin.D.T.shape) * ~lin.D.any(axis=1)
    return robot, fflin.LinearController(
        (controller.A, controller.B, controller.C, D, lin.dt), lin
    )


@functools.cache
def law(kind):
    if kind in ("hybrid", "local", "world"):
        robot = fflin.load("servicer_7dof")
        return robot, about(robot, kind)
    if kind == "wheels":  # continuous joints
        robot = fflin.load("cubesat", inputs=fflin.load_inputs("cubesat"))
        lin = fflin.linearize(robot)
        return robot, fflin.StateFeedback(lin, np.ones(lin.B.T.shape))
    if kind == "no joints":
        robot = fflin.load("cubesat")
        return robot, about(robot)
    if kind == "orbit":
        robot = fflin.load("planar_detumble", orbit=fflin.CircularOrbit(500e3))
        lin = fflin.linearize(robot)
        return robot, fflin.StateFeedback(lin, np.ones(lin.B.T.shape))
    if kind == "grid":
        robot, policy, _ = between_gains(fflin.load("servicer_7dof"))
        return robot, policy
    if kind == "lqg":
        robot, lin, controller = compensated(fflin.load("servicer_7dof"))
        return robot, fflin.OutputFeedback(lin, controller)
    if kind == "mixed":
        return mixed()
    robot, _, schedule = tracking()
    return robot, schedule


KINDS = (
    *("hybrid", "local", "world", "wheels", "no joints", "orbit"),
    *("grid", "lqg", "mixed", "schedule"),
)
# Kinds whose code for float is compiled by default. Together they have each function of the code.
FLOATS = ("wheels", "lqg", "schedule")


@pytest.mark.parametrize("compiler", COMPILERS)
@pytest.mark.parametrize(
    ("real", "kind"),
    [
        *(("double", kind) for kind in KINDS),
        *(("float", kind) for kind in FLOATS),
        *exhaustive(*(("float", kind) for kind in KINDS if kind not in FLOATS)),
    ],
)
def test_the_code_compiles_and_agrees(kind, real, compiler, tmp_path):
    robot, controller = law(kind)
    folder = fflin.write_c(controller, tmp_path, robot=robot, real=real)
    code, message = outcome(folder, compiler)
    assert (code, message) == (0, "all cases agree, 0 differences\n")


@pytest.mark.parametrize("kind", ["hybrid", "lqg", "schedule"])
def test_limits_are_reached_and_told(kind, tmp_path):
    robot, controller = law(kind)
    folder = fflin.write_c(controller, tmp_path, robot=robot, limits=0.05)
    assert outcome(folder, COMPILERS[0])[0] == 0
    source = (folder / "controller_test.c").read_text()
    statuses = re.findall(r", ([01])\}", source)
    assert len(statuses) == 200
    assert "1" in statuses


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("kind", "change"),
    [
        ("local", ("? r : q, -1", "? r : q, 1")),
        ("wheels", ("*angle -=", "*angle +=")),
        ("lqg", ("A[i][j] * memory", "-A[i][j] * memory")),
        ("schedule", ("feed_back((int)row", "feed_back(0")),
        *exhaustive(
            ("hybrid", ("< 0 ? -1 : 1", "< 0 ? 1 : -1")),
            ("hybrid", ("r[0] * q[3] -", "r[0] * q[3] +")),
            (
                "hybrid",
                ("const controller_real x = two *", "const controller_real x = -two *"),
            ),
            ("world", ("rotate(q, 1", "rotate(q, -1")),
            ("hybrid", ("u[i] -= weight", "u[i] += weight")),
            ("grid", ("upper ? share[a]", "!upper ? share[a]")),
            ("mixed", ("D[i][j] * dy", "-D[i][j] * dy")),
            ("lqg", ("memory->z[i] = next[i]", "memory->z[i] = -next[i]")),
        ),
    ],
)
def test_the_test_program_finds_a_changed_line(kind, change, tmp_path):
    robot, controller = law(kind)
    folder = fflin.write_c(controller, tmp_path, robot=robot)
    source = (folder / "controller.c").read_text()
    assert source.count(change[0]) >= 1
    (folder / "controller.c").write_text(source.replace(*change))
    code, message = outcome(folder, COMPILERS[0])
    assert code == 1
    assert re.search(r"case \d+: .+ is \S+, expected ", message)


def test_the_header_names_every_entry(tmp_path):
    robot, controller = law("hybrid")
    fflin.write_c(controller, tmp_path, name="arm", real="float")  # which is replaced
    header = (fflin.write_c(controller, tmp_path, name="arm") / "arm.h").read_text()
    for name in (
        *controller.lin.state_names,
        *controller.lin.input_names,
        robot.urdf_sha256,
        fflin.__version__,
    ):
        assert name in header
    assert "typedef double arm_real;" in header


def test_the_code_has_no_state_and_calls_sqrt_alone(tmp_path):
    controller = law("grid")[1]
    source = (fflin.write_c(controller, tmp_path) / "controller.c").read_text()
    header = (tmp_path / "controller.h").read_text()
    assert (
        f"K interpolated linearly over {', '.join(controller.table()[0])}, constant outside"
        in header
    )
    assert not re.search(r"^static (?!const|int|void)", source, re.MULTILINE)
    called = set(
        re.findall(r"\b(\w+)\(", re.sub(r"/\*.*?\*/", "", source, flags=re.DOTALL))
    )
    default = set(
        re.findall(r"^(?:static )?(?:int|void) (\w+)\(", source, re.MULTILINE)
    )
    assert called - default <= {"sqrt", "if", "for"}


FLIGHTS = {
    "hybrid": {},
    "local": {},
    "world": {"limits": "urdf"},
    "wheels": {"duration": 0.5},
    "no joints": {},
    "grid": {},
    "lqg": {},
    "schedule": {"duration": 2.5},
}


@pytest.mark.exhaustive
@pytest.mark.parametrize("kind", FLIGHTS)
def test_a_simulation_with_the_code_is_the_simulation_without(kind, tmp_path):
    if kind in ("hybrid", "local", "world"):  # sampled
        robot = fflin.load("servicer_7dof")
        controller = about(robot, kind, dt=0.1)
    elif kind == "wheels":
        robot, _ = law(kind)
        lin = fflin.linearize(robot)
        controller = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    else:
        robot, controller = law(kind)
    code = fflin.CLaw(fflin.write_c(controller, tmp_path, robot=robot))
    joints = dict.fromkeys(robot.joint_names[-1:], 0.2)
    turned = POSE * pin.SE3(
        pin.rpy.rpyToMatrix(0.1, 0.2, 0.3), np.array([0.02, 0.0, 0.1])
    )
    q0 = (
        robot.neutral()
        if kind == "schedule"
        else fflin.configuration(robot, joints, turned)
    )
    options = {"q0": q0, "duration": 1.0, "dt": 0.01, "engine": "python"} | FLIGHTS[
        kind
    ]
    one, other = (fflin.simulate(robot, item, **options) for item in (controller, code))
    scale = 1.0 + np.abs(one.u).max()
    assert np.abs(one.q - other.q).max() < 1e-12
    assert np.abs(one.v - other.v).max() < 1e-12
    assert np.abs(one.u - other.u).max() < 1e-12 * scale


def test_a_law_from_a_file_needs_its_robot(tmp_path):
    robot = fflin.load("planar_detumble")
    gain = fflin.lqr(fflin.linearize(robot))
    gain.save(tmp_path / "gain.npz")
    loaded = fflin.Gain.load(tmp_path / "gain.npz")
    one, other = (
        fflin.write_c(x, tmp_path / f"{k}") for k, x in enumerate((gain, loaded))
    )
    assert (one / "controller.c").read_bytes() == (other / "controller.c").read_bytes()
    unknown = replace(loaded, robot="of my own")
    with pytest.raises(fflin.InputError, match="robot="):
        fflin.write_c(unknown, tmp_path / "none")
    fflin.write_c(unknown, tmp_path / "given", robot=robot)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        ({"name": "3d"}, "a letter"),
        ({"name": "math"}, "not float, math"),
        ({"real": "half"}, "'double' or 'float'"),
        ({"law": 3}, "Gain, StateFeedback"),
        ({"robot": "cubesat"}, "a Robot"),
        ({"law": "continuous"}, "sampled gains"),
        ({"law": "compensator"}, "continuous, expected a sampled"),
    ],
)
def test_a_law_that_cannot_be_exported_is_refused(change, match, tmp_path):
    robot, controller = law("hybrid")
    if change.get("law") == "continuous":
        robot, along, _ = tracking()
        change = {"law": fflin.tvlqr(along), "robot": robot}
    if change.get("law") == "compensator":
        change = {
            "law": fflin.lqg(
                fflin.lqr(controller.lin), fflin.kalman(controller.lin, 1e-3, 1e-4)
            )
        }
    options = {"law": controller} | change
    with pytest.raises(fflin.InputError, match=match):
        fflin.write_c(options.pop("law"), tmp_path / "none", **options)
    assert not (tmp_path / "none").exists()


def test_the_code_is_not_flown_with_another_robot(tmp_path):
    code = fflin.CLaw(fflin.write_c(law("hybrid")[1], tmp_path))
    with pytest.raises(
        fflin.InputError, match="the given robot 'planar_detumble' lacks"
    ):
        code.bind(fflin.load("planar_detumble"))
    with pytest.raises(fflin.FileError, match=r"nowhere: No such file"):
        fflin.CLaw(tmp_path / "nowhere")
    with pytest.raises(fflin.FileError, match="contains no C code named 'other' that"):
        fflin.CLaw(tmp_path, name="other")
    with pytest.raises(fflin.MissingPackageError, match="no C compiler"):
        fflin.CLaw(tmp_path, compiler="no_such_compiler")


@pytest.mark.exhaustive
@pytest.mark.parametrize(
    ("ending", "dt"),
    [
        ("npz", 0.0),
        ("json", 0.1),
        *exhaustive(("npz", 0.1), ("json", 0.0), ("mat", 0.0), ("mat", 0.1)),
    ],
)
def test_a_gain_from_a_file_keeps_its_pose_and_sample_time(ending, dt, tmp_path):
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot, fflin.configuration(robot, {"joint_2": 0.4}, POSE))
    gain = fflin.lqr(lin.discretize(dt) if dt else lin)
    gain.save(tmp_path / f"gain.{ending}")
    loaded = fflin.Gain.load(tmp_path / f"gain.{ending}")
    one, other = (
        fflin.write_c(x, tmp_path / f"{k}") for k, x in enumerate((gain, loaded))
    )
    assert fflin.CLaw(other).dt == dt
    in_memory, from_file = (fflin.CLaw(x).bind(robot) for x in (one, other))
    random = np.random.default_rng(4)
    for _ in range(5):
        turn = pin.SE3(pin.exp3(random.normal(size=3)), random.normal(size=3))
        q = fflin.configuration(robot, {"joint_3": random.normal()}, POSE * turn)
        v = random.normal(size=robot.nv)
        u = in_memory(0.0, q, v)
        assert from_file(0.0, q, v) == pytest.approx(
            u, rel=1e-11, abs=1e-11 * np.abs(u).max()
        )


def test_a_gain_from_a_file_is_not_written_for_another_robot(tmp_path):
    robot = fflin.load("planar_detumble")
    gain = fflin.lqr(
        fflin.linearize(robot.with_mass_properties({"base": {"mass": 900.0}}))
    )
    gain.save(tmp_path / "gain.npz")
    loaded = fflin.Gain.load(tmp_path / "gain.npz")
    with pytest.raises(fflin.InputError, match="another URDF or other masses than"):
        fflin.write_c(loaded, tmp_path / "none")


@pytest.mark.parametrize("saved", [False, True])
@pytest.mark.parametrize("kind", ["compensator", "schedule"])
def test_a_law_is_not_written_for_another_robot_of_the_same_name(kind, saved, tmp_path):
    path = tmp_path / "planar_detumble.urdf"
    xml = find_robot("planar_detumble").path.read_text()
    path.write_text(xml.replace("</robot>", "<!-- with other limits --></robot>"))
    robot = fflin.load(path)
    if kind == "compensator":
        lin = fflin.linearize(robot).discretize(0.1)
        controller = fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4))
    else:
        v0 = fflin.velocity(robot, {"joint_1": 0.1})
        motion = fflin.simulate(robot, v0=v0, duration=2.0, every=20)
        controller = fflin.tvlqr(
            fflin.linearize_trajectory(robot, motion.trajectory()), sample=0.1
        )
    if saved:
        controller.save(tmp_path / "by.npz")
        controller = type(controller).load(tmp_path / "by.npz")
    for options in ({}, {"robot": fflin.load("ets_vii")}):
        with pytest.raises(fflin.InputError, match="another URDF or other masses than"):
            fflin.write_c(controller, tmp_path / "none", **options)
    folder = fflin.write_c(controller, tmp_path / "c", robot=robot)
    assert robot.urdf_sha256 in (folder / "controller.h").read_text()
    assert not (tmp_path / "none").exists()


def test_the_code_is_not_flown_with_other_continuous_joints(tmp_path):
    xml = find_robot("servicer_7dof").path.read_text()
    (tmp_path / "own.urdf").write_text(
        xml.replace('type="revolute"', 'type="continuous"')
    )
    robot = fflin.load("servicer_7dof")
    code = fflin.CLaw(fflin.write_c(fflin.lqr(fflin.linearize(robot)), tmp_path / "c"))
    turning = fflin.load(tmp_path / "own.urdf")
    assert turning.nq > robot.nq
    with pytest.raises(fflin.InputError, match="has other continuous joints"):
        code.bind(turning)


@pytest.mark.exhaustive
@pytest.mark.parametrize("ending", ["c", "h", "json"])
def test_files_of_another_law_or_edited_ones_are_refused(ending, tmp_path):
    """A pair of which one file is of another law, though both are valid."""
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot)
    folders = [
        fflin.write_c(
            fflin.StateFeedback(lin, k * fflin.lqr(lin).K), tmp_path / f"{k}", real=real
        )
        for k, real in ((1.0, "double"), (2.0, "float"))
    ]
    one, other = (folder / f"controller.{ending}" for folder in folders)
    assert one.read_bytes() != other.read_bytes()
    one.write_bytes(other.read_bytes())
    with pytest.raises(fflin.FileError, match="does not belong to"):
        fflin.CLaw(folders[0])
    fflin.CLaw(folders[1])


def test_a_folder_holds_several_laws_and_none_is_lost(tmp_path):
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot).discretize(0.1)
    gain, controller = (
        fflin.lqr(lin),
        fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4)),
    )
    fflin.write_c(gain, tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    for law in (controller, fflin.lqr(fflin.linearize(fflin.load("cubesat")))):
        with pytest.raises(
            fflin.InputError, match=r"controller\.h exists and does not belong to"
        ):
            fflin.write_c(law, tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    fflin.write_c(fflin.OutputFeedback(lin, controller), tmp_path, name="filter")
    fflin.write_c(fflin.lqr(lin, 2.0, 1.0), tmp_path)  # the same gain, tuned again
    with pytest.raises(
        fflin.FileError, match="contains the laws controller, filter; choose one"
    ):
        fflin.CLaw(tmp_path)
    names = [fflin.CLaw(tmp_path, name=name).name for name in ("controller", "filter")]
    assert names == ["controller", "filter"]
    (tmp_path / "own.c").write_text("int main(void) { return 0; }")
    with pytest.raises(fflin.InputError, match=r"own\.c exists"):
        fflin.write_c(gain, tmp_path, name="own")


@pytest.mark.parametrize("ending", ["c", "h"])
def test_edited_code_is_not_overwritten(ending, tmp_path):
    controller = law("no joints")[1]
    fflin.write_c(controller, tmp_path)
    path = tmp_path / f"controller.{ending}"
    path.write_text(f"{path.read_text()}/* reviewed */\n")
    before = {item: item.read_bytes() for item in tmp_path.iterdir()}
    with pytest.raises(fflin.InputError, match="or the code was edited"):
        fflin.write_c(controller, tmp_path)
    assert {item: item.read_bytes() for item in tmp_path.iterdir()} == before


def test_a_schedule_is_written_again_over_itself(tmp_path):
    robot, controller = law("schedule")
    for _ in range(2):
        fflin.write_c(controller, tmp_path, robot=robot)
    assert "in C99: GainSchedule\n" in (tmp_path / "controller.h").read_text()


def test_folders_that_cannot_be_used_are_one_line(tmp_path, monkeypatch):
    controller = law("no joints")[1]
    (tmp_path / "file").touch()
    for folder, message in (
        ("a" * 300, "File name too long"),
        ("file/c", "Not a directory"),
    ):
        with pytest.raises(fflin.FileError, match=message):
            fflin.write_c(controller, tmp_path / folder)
        with pytest.raises(fflin.FileError, match=message):
            fflin.CLaw(tmp_path / folder)
    fflin.write_c(controller, tmp_path / "c")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "none"))
    with any_wording(), pytest.raises(fflin.InputError, match="'cc' made no library"):
        fflin.CLaw(tmp_path / "c")  # the name of the temporary folder is random


def test_a_failure_leaves_no_folder(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "own").mkdir()
    monkeypatch.setattr(Path, "write_bytes", full)
    for folder in ("new/deep", "own/new", "own"):
        with pytest.raises(fflin.FileError, match="No space left"):
            fflin.write_c(law("no joints")[1], tmp_path / folder)
    assert [*tmp_path.rglob("*")] == [tmp_path / "own"]


@pytest.mark.parametrize("real", ["double", "float"])
def test_invalid_arguments_give_the_inputs_at_the_target_and_a_state_of_zeros(
    real, tmp_path
):
    robot, controller = law("hybrid")
    code = fflin.CLaw(fflin.write_c(controller, tmp_path, real=real, limits=0.5))
    library = _compiled(tmp_path / "controller.c", "cc")
    kind = np.float64 if real == "double" else np.float32
    good = measured(StateMap(robot), controller.lin.q, controller.lin.v).astype(kind)
    u0, seen = np.clip(controller.lin.u0, -0.5, 0.5), set()
    for index, value in product(
        range(len(good)), (np.nan, np.inf, -np.inf, np.finfo(kind).max)
    ):
        given, x, u = (
            np.full(len(item), 7.0, kind) for item in (good, controller.lin.x0, u0)
        )
        given[:] = good
        given[index] = value
        status = library.controller_state(given.ctypes, x.ctypes)
        assert not x.any() if status == 2 else np.isfinite(x).all()
        status = library.controller_step(given.ctypes, u.ctypes)
        assert (
            u == pytest.approx(u0, abs=1e-12)
            if status == 2
            else (np.abs(u) <= 0.5).all()
        )
        seen.add((bool(np.isfinite(value)), status))
    # A finite argument that is too large reaches the limits, or overflows.
    assert seen == {(False, 2), (True, 1), (True, 2)}
    assert repr(code).startswith("CLaw('controller'")


def test_copies_of_the_code_fly_as_the_code(tmp_path):
    robot, controller = law("no joints")
    code = fflin.CLaw(fflin.write_c(controller, tmp_path))
    q = fflin.configuration(robot, {}, POSE)
    u = code.bind(robot)(0.0, q, np.zeros(robot.nv))
    for other in (copy.deepcopy(code), pickle.loads(pickle.dumps(code))):
        assert (other.bind(robot)(0.0, q, np.zeros(robot.nv)) == u).all()


@pytest.fixture(scope="module")
def about_neutral(tmp_path_factory):
    """A robot, its regulator about the neutral pose, and the C code of the regulator."""
    robot = fflin.load("cubesat")
    lin = fflin.linearize(robot)
    controller = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    code = fflin.CLaw(fflin.write_c(controller, tmp_path_factory.mktemp("neutral")))
    return robot, controller, code


@pytest.mark.parametrize("side", [1.0, -1.0])
@pytest.mark.parametrize("axis", [*np.eye(4)[:3].tolist(), [0.6, 0.8, 0.0, 0.0]])
def test_half_a_turn_is_decided_as_in_python(axis, side, about_neutral):
    """Both ways back are equally short: the sign of the quaternion decides, in C as in Python."""
    robot, controller, code = about_neutral
    q, v = np.append(np.zeros(3), side * np.array(axis)), np.zeros(robot.nv)
    u, other = code.bind(robot)(0.0, q, v), controller.bind(robot)(0.0, q, v)
    assert np.abs(u).max() > 0.0
    assert u == pytest.approx(other, rel=1e-14, abs=1e-14 * np.abs(other).max())


def test_units_of_a_compensator_match_its_robot(tmp_path):
    robot = fflin.load("planar_detumble")
    lin = fflin.linearize(robot).discretize(0.1)
    controller = replace(
        fflin.lqg(fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-4)), robot="of my own"
    )
    with pytest.raises(fflin.InputError, match="robot="):
        fflin.write_c(controller, tmp_path / "none")
    header = (
        fflin.write_c(controller, tmp_path, robot=robot) / "controller.h"
    ).read_text()
    assert "u[0]  tau_b.x [N m]" in header
    assert "omega_b.z [rad/s]" in header
    assert "[unknown]" not in header


@pytest.mark.parametrize(
    "change", [[], {"reference": [1, 2]}, {"dt": "x"}, {"kind": "zz"}, {"real": "half"}]
)
def test_a_damaged_folder_is_one_line(change, tmp_path):
    fflin.write_c(law("no joints")[1], tmp_path)
    path = tmp_path / "controller.json"
    about_law = json.loads(path.read_text())
    path.write_text(json.dumps({**about_law, **change} if change else []))
    with pytest.raises(
        fflin.FileError, match=r"controller\.json: (not a|does not belong)"
    ):
        fflin.CLaw(tmp_path)
