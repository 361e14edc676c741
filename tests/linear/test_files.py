"""Models on disk: exact to the last bit, readable by others, whole or not at all."""

import csv
import json
import os
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest

import fflin
from tests.support.messages import any_wording
from tests.support.robots import random_point

LOADED = (".npz", ".mat", ".json")
FORMATS = (*LOADED, ".csv")
KEYS = {
    *(
        "A",
        "B",
        "C",
        "D",
        "f0",
        "x0",
        "u0",
        "state_names",
        "input_names",
        "output_names",
    ),
    *("state_units", "input_units", "output_units", "frame", "q", "v", "dt", "robot"),
    *("urdf_sha256", "fflin_version", "pinocchio_version", "certificate"),
}


@pytest.fixture(scope="module", params=["cubesat", "planar_detumble", "astrobee_arm"])
def lin(request):
    robot = fflin.load(request.param)
    return fflin.linearize(
        robot, *random_point(robot, np.random.default_rng(1)), frame="world"
    )


@pytest.mark.parametrize("ending", LOADED)
@pytest.mark.parametrize("dt", [0.0, 0.1])
def test_round_trip_is_exact(lin, ending, dt, tmp_path):
    saved = lin.discretize(dt) if dt else lin
    path = tmp_path / f"model{ending}"
    saved.save(path)
    loaded = fflin.LinearModel.load(path)
    for field in fields(saved):
        made = ("_certify", "_inertia", "_ignorable", "_wheels", "_limits", "_robot")
        if field.name in (*made, "_source"):
            continue
        before, after = getattr(saved, field.name), getattr(loaded, field.name)
        if isinstance(before, np.ndarray):
            assert (
                before.shape == after.shape and before.tobytes() == after.tobytes()
            ), field.name
        else:
            assert before == after and type(before) is type(after), field.name
    assert loaded.certificate == saved.certificate == lin.certificate
    assert loaded.reference == saved.reference and loaded.ignorable == saved.ignorable
    assert loaded.wheels == saved.wheels == lin.wheels
    assert loaded.limits == saved.limits == lin.limits
    assert (loaded.M == saved.M).all() and not loaded.M.flags.writeable
    if not dt:
        assert fflin.check(fflin.load(lin.robot), loaded).ok


def test_keys_are_the_settled_ones(lin, tmp_path):
    for ending in (".npz", ".json", ".mat"):
        lin.save(tmp_path / f"m{ending}")
    with np.load(tmp_path / "m.npz", allow_pickle=False) as file:
        assert KEYS <= set(file.files)
        assert json.loads(str(file["certificate"]))["f0"] == lin.certificate.f0
    record = json.loads((tmp_path / "m.json").read_text())
    assert KEYS <= set(record)
    assert record["urdf_sha256"] == lin.urdf_sha256 and len(lin.urdf_sha256) == 64
    from scipy.io import loadmat

    mat = loadmat(tmp_path / "m.mat", simplify_cells=True)
    assert KEYS <= set(mat)
    assert (mat["A"] == lin.A).all()
    assert tuple(mat["state_names"]) == lin.state_names
    assert mat["certificate"]["route_B"] == lin.certificate.route_B


def test_csv_names_rows_and_columns(lin, tmp_path):
    lin.save(tmp_path / "m.csv")
    names = {"x": lin.state_names, "u": lin.input_names, "y": lin.output_names}
    names["v"] = lin.state_names[-len(lin.M) :]
    for key, (of_rows, of_columns) in zip(
        "ABCDM", ("xx", "xu", "yx", "yu", "vv"), strict=True
    ):
        with (tmp_path / f"m.{key}.csv").open(newline="") as file:
            head, *rows = csv.reader(file)
        assert tuple(head[1:]) == names[of_columns]
        assert tuple(row[0] for row in rows) == names[of_rows]
        assert [list(map(float, row[1:])) for row in rows] == getattr(lin, key).tolist()
    with pytest.raises(fflin.FileError, match=r"'\.csv'.*\.npz, \.mat, \.json"):
        fflin.LinearModel.load(tmp_path / "m.csv")
    with (tmp_path / "m.inputs.csv").open(newline="") as file:
        head, *rows = csv.reader(file)
    assert head == ["name", "unit", "u0"]
    assert tuple(row[1] for row in rows) == lin.input_units
    assert [float(row[2]) for row in rows] == lin.u0.tolist()
    with (tmp_path / "m.info.csv").open(newline="") as file:
        info = dict(csv.reader(file))
    assert (info["robot"], info["frame"]) == (lin.robot, "world")
    assert json.loads(info["q"]) == lin.q.tolist()
    assert json.loads(info["certificate"])["route_B"] == lin.certificate.route_B


def test_nothing_is_left_behind_where_writing_fails(lin, tmp_path, monkeypatch):
    for ending in FORMATS:
        with pytest.raises(fflin.FileError, match="folder"):
            lin.save(tmp_path / "missing" / f"m{ending}")
        target = tmp_path / f"old{ending}"
        target.write_text("precious")

    def full(_source, _target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    before = sorted(tmp_path.iterdir())
    for ending in FORMATS:
        with pytest.raises(fflin.FileError, match="No space left on device"):
            lin.save(tmp_path / f"old{ending}")
        assert (tmp_path / f"old{ending}").read_text() == "precious"
    assert sorted(tmp_path.iterdir()) == before


def test_invalid_paths_are_reported(lin, tmp_path):
    with pytest.raises(fflin.FileError, match=r"'\.xls'"):
        lin.save(tmp_path / "m.xls")
    (tmp_path / "folder.npz").mkdir()
    with pytest.raises(fflin.FileError, match="folder"):
        lin.save(tmp_path / "folder.npz")
    with pytest.raises(fflin.FileError, match="No such file"):
        fflin.LinearModel.load(tmp_path / "none.npz")


@pytest.mark.parametrize("ending", LOADED)
@pytest.mark.parametrize("content", [b"", b"rubbish", b"{}", b"PK\x03\x04broken"])
def test_other_files_are_refused(ending, content, tmp_path):
    path = tmp_path / f"m{ending}"
    path.write_bytes(content)
    with pytest.raises(fflin.FileError, match="linear model"):
        fflin.LinearModel.load(path)


def test_truncated_file_is_refused(lin, tmp_path):
    for ending in (".npz", ".mat", ".json"):
        path = tmp_path / f"m{ending}"
        lin.save(path)
        whole = path.read_bytes()
        for share in (0.3, 0.9):
            path.write_bytes(whole[: int(share * len(whole))])
            with any_wording(), pytest.raises(fflin.FileError):
                fflin.LinearModel.load(path)


def test_a_link_stays_a_link_and_other_kinds_are_refused(lin, tmp_path):
    target, link = tmp_path / "real.json", tmp_path / "link.json"
    target.write_text("old")
    target.chmod(0o600)
    link.symlink_to(target)
    lin.save(link)
    assert link.is_symlink() and fflin.LinearModel.load(target).robot == lin.robot
    assert target.stat().st_mode & 0o777 == 0o600
    os.mkfifo(tmp_path / "pipe.json")
    with pytest.raises(fflin.FileError, match="regular file"):
        lin.save(tmp_path / "pipe.json")
    assert not list(tmp_path.glob(".fflin*"))
    for path in (3, None, b"m.npz", "a\0b.npz"):
        for call in (lin.save, fflin.LinearModel.load):
            with pytest.raises(fflin.InputError, match="path"):
                call(path)


def test_damaged_figures_are_refused(lin, tmp_path):
    path = tmp_path / "m.json"
    lin.save(path)
    record = json.loads(path.read_text())
    for key, value in {
        "reference": [1, 2],
        "x0": [0.0],
        "M": [],
        "state_units": [],
        "frame": "body",
        "A": [[float("nan")] * len(lin.x0)] * len(lin.x0),
    }.items():
        path.write_text(json.dumps({**record, key: value}))
        with pytest.raises(fflin.FileError, match="linear model"):
            fflin.LinearModel.load(path)
    path.write_text("[" * 100_000)
    with pytest.raises(fflin.FileError):
        fflin.LinearModel.load(path)


def test_certificate_is_bound_to_its_matrices(lin, tmp_path):
    lin.save(tmp_path / "m.npz")
    for good in (fflin.LinearModel.load(tmp_path / "m.npz"), lin.discretize(0.1)):
        assert good.certificate == lin.certificate
        with pytest.raises(fflin.InputError, match="certificate was computed"):
            _ = replace(good, B=3 * good.B).certificate


def test_path_may_be_a_string(lin, tmp_path):
    lin.save(str(tmp_path / "m.json"))
    assert fflin.LinearModel.load(str(tmp_path / "m.json")).robot == lin.robot
    # as the umask says
    assert Path(tmp_path / "m.json").stat().st_mode & 0o044 == 0o044
