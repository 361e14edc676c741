"""Every kind of record in every format: exact, told from a damaged one, and never a crash."""

import hashlib
import io
import json
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
import scipy.sparse

import fflin
from fflin.base.record import CODECS, content_digest, read_record, write_record
from fflin.base.validation import NOT_VERIFIED
from fflin.base.writing import RECORDS
from tests.support.messages import any_wording
from tests.support.robots import mostly

FLIPS = 150


_DESIGNS = {"gain": fflin.lqr, "estimator": fflin.kalman}


@cache
def made(kind):
    """A thing of a kind that is saved, small."""
    robot = fflin.load("cubesat" if kind == "schedule" else "astrobee_arm")
    lin = fflin.linearize(robot)
    if kind == "schedule":
        rows = [np.tile(x, (3, 1)) for x in (lin.q, lin.v, lin.u0)]
        trajectory = fflin.linearize_trajectory(robot, [0.0, 0.1, 0.2], *rows)
        return fflin.tvlqr(trajectory, 1e-3, 1e3, 1e-3)
    if kind in ("batch", "gains"):
        batch = fflin.sweep(robot, fflin.random_configurations(robot, 6, seed=1))
        return batch if kind == "batch" else fflin.lqr_batch(batch, 1.0, 1.0)
    if kind == "compensator":
        return fflin.lqg(made("gain"), made("estimator"))
    if kind == "motion":
        return fflin.simulate(robot, duration=0.05, dt=0.01)
    return lin if kind == "model" else _DESIGNS[kind](lin, 1.0, 1.0)


FORMATS = {
    "batch": (".npz", ".h5"),
} | dict.fromkeys(
    ("model", "gain", "schedule", "estimator", "motion", "gains"),
    (".npz", ".mat", ".json"),
)
OTHERS = ["gain", "model", "estimator", "compensator", "motion", "schedule"]
CASES = [(kind, ending) for kind, endings in FORMATS.items() for ending in endings]


def content(thing):
    """All that a thing holds, bit for bit, but for whether it is verified."""
    held = {}
    for field in fields(thing):
        value = getattr(thing, field.name)
        if field.name in ("verified", "_robot", "_about", "_asked", "_lin"):
            continue
        if callable(value):
            continue
        held[field.name] = (
            (value.shape, np.ascontiguousarray(value).tobytes())
            if isinstance(value, np.ndarray)
            else value
        )
    if isinstance(thing, fflin.LinearModel):
        held |= {"M": thing.M.tobytes(), "certificate": thing.certificate}
        held["ignorable"] = thing.ignorable
    if isinstance(thing, fflin.LinearBatch):
        held["ignorable"] = thing[0].ignorable
    for name in ("_ignorable", "_robot", "_source"):
        held.pop(name, None)
    return held


def files_of(path):
    return sorted(path.parent.glob(f"{path.stem}.*"))


@pytest.mark.parametrize(
    "flips", [FLIPS // 6, pytest.param(FLIPS, marks=pytest.mark.fuzz)]
)
@pytest.mark.parametrize(("kind", "ending"), CASES)
def test_no_flipped_bit_is_silent_or_a_crash(kind, ending, flips, tmp_path):
    thing, path = made(kind), tmp_path / f"x{ending}"
    thing.save(path)
    load = type(thing).load
    whole = load(path)
    assert (
        whole.verified
        and content(whole) == content(thing)
        and NOT_VERIFIED not in str(whole)
    )
    rng = np.random.default_rng(sum(map(ord, kind + ending)))
    files = {file: file.read_bytes() for file in files_of(path)}
    sizes = np.array([len(data) for data in files.values()])
    refused = 0
    for _ in range(flips):
        file = list(files)[rng.choice(len(sizes), p=sizes / sizes.sum())]
        damaged = bytearray(files[file])
        damaged[rng.integers(len(damaged))] ^= 1 << rng.integers(8)
        file.write_bytes(damaged)
        try:
            read = load(path)
        except fflin.FileError as error:
            refused += 1
            assert "\n" not in str(error)
        else:
            # In padding, or in the digest's own name, after which it is said to be unverified.
            assert content(read) == content(thing)
        file.write_bytes(files[file])
    assert refused > 0.5 * flips


@pytest.mark.parametrize("kind", ["model", "gain"])
def test_every_bit_of_the_header_of_a_mat_file_is_checked(kind, tmp_path):
    """Header and digest, where a flip is the likeliest to be taken for a file of another."""
    thing, path = made(kind), tmp_path / "x.mat"
    thing.save(path)
    whole = path.read_bytes()
    for bit in range(0, 8 * 136, 3):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            read = type(thing).load(path)
        except fflin.FileError:
            continue
        assert content(read) == content(thing)
        assert not read.verified and NOT_VERIFIED in str(read)


def unsealed(path):
    """Write a file anew as others, and earlier versions, write it: without a digest."""
    data = path.read_bytes()
    if path.suffix == ".npz":
        with np.load(io.BytesIO(data)) as file:
            np.savez(path, **{key: file[key] for key in file.files if key != "sha256"})
    elif path.suffix == ".mat":
        path.write_bytes(
            b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(116) + data[116:]
        )
    elif path.suffix == ".json":
        record = json.loads(data)
        assert record.pop("sha256")
        path.write_text(json.dumps(record))
    else:
        h5py = pytest.importorskip("h5py")
        with h5py.File(path, "r+") as file:
            del file["sha256"], file["chunk_sha256"], file.attrs["chunk"]


@pytest.mark.parametrize(("kind", "ending"), CASES)
def test_a_file_without_a_digest_is_read_and_said_to_be_unverified(
    kind, ending, tmp_path
):
    if ending == ".h5":
        pytest.importorskip("h5py")
    thing, path = made(kind), tmp_path / f"x{ending}"
    thing.save(path)
    unsealed(path)
    read = type(thing).load(path)
    assert not read.verified and content(read) == content(thing)
    assert str(read).endswith(NOT_VERIFIED)
    if kind == "batch":
        assert not read[0].verified
    # Saved anew it has none either.
    read.save(path)
    anew = type(thing).load(path)
    assert not anew.verified and content(anew) == content(thing)


@pytest.mark.parametrize(
    "trials", [FLIPS, pytest.param(6 * FLIPS, marks=pytest.mark.fuzz)]
)
@pytest.mark.parametrize("ending", [".npz", ".json"])
def test_a_damaged_file_without_a_digest_is_not_a_crash(ending, trials, tmp_path):
    thing, path = made("gain"), tmp_path / f"x{ending}"
    thing.save(path)
    unsealed(path)
    whole, rng = path.read_bytes(), np.random.default_rng(5)
    for trial in range(trials):
        damaged = bytearray(whole)
        for _ in range(1 + trial % 3):
            damaged[rng.integers(len(damaged) if trial % 2 else 400)] ^= (
                1 << rng.integers(8)
            )
        path.write_bytes(
            damaged if trial % 5 else damaged[: rng.integers(len(damaged))]
        )
        try:
            assert not fflin.Gain.load(path).verified
        except fflin.FileError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        ("gain", {"dt": -1.0}, "dt is -1"),
        ("gain", {"dt": np.nan}, "dt is nan"),
        ("gain", {"margin": np.inf}, "margin is inf"),
        ("gain", {"x0": np.zeros(30) + 1j}, "x0 is not an array of finite numbers"),
        ("gain", {"placement": np.zeros(3)}, "placement"),
        ("gain", {"placement": np.zeros(7)}, "placement"),
        ("gain", {"input_units": ["N m"]}, "number of its input_units"),
        ("schedule", {"K": np.zeros((2, 6))}, "K has shape"),
        ("schedule", {"K": np.zeros((3, 6, 13))}, "shape"),
        ("schedule", {"t": np.zeros(2)}, "shape"),
        ("estimator", {"L": np.zeros((3, 3))}, "L has shape"),
        ("estimator", {"C": np.zeros((30, 3))}, "shape"),
        ("compensator", {"A": np.zeros(3)}, "A has shape"),
        ("compensator", {"C": np.zeros((8, 15))}, "shape"),
        ("compensator", {"y0": np.zeros(3)}, "shape"),
        ("model", {"dt": -1.0}, "dt is -1"),
        ("model", {"reference": np.zeros(7)}, "placement"),
        ("model", {"state_units": ["rad"]}, "number of its state_units"),
    ],
)
def test_an_impossible_value_in_a_file_without_a_digest_is_refused(
    kind, change, message, tmp_path
):
    thing, path = made(kind), tmp_path / "x.npz"
    thing.save(path)
    with np.load(path) as file:
        record = {key: file[key] for key in file.files if key != "sha256"}
    assert change.keys() <= record.keys()
    np.savez(path, **record | change)
    with pytest.raises(fflin.FileError, match=rf"x\.npz: .*{message}"):
        type(thing).load(path)


def test_an_edited_file_is_refused_with_a_remedy(tmp_path):
    path = tmp_path / "x.json"
    made("model").save(path)
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record))
    with pytest.raises(fflin.FileError, match="sha256"):
        fflin.LinearModel.load(path)
    made("model").save(path)
    path.write_text(path.read_text().replace('"dt": 0.0', '"dt": 0.1'))
    with pytest.raises(fflin.FileError, match="sha256"):
        fflin.LinearModel.load(path)


def test_each_ending_has_a_codec():
    assert tuple(CODECS) == RECORDS


def test_the_digest_is_as_documented(tmp_path):
    """Others can make and check it."""
    for ending in (".npz", ".mat", ".json"):
        made("model").save(tmp_path / f"x{ending}")
    text = (tmp_path / "x.json").read_text()
    body, _, checksum = text.partition(',\n"sha256": "')
    assert checksum == hashlib.sha256(body.encode()).hexdigest() + '"\n}\n'
    data = (tmp_path / "x.mat").read_bytes()
    assert data[:116].split()[-1].decode() == hashlib.sha256(data[116:]).hexdigest()
    with np.load(tmp_path / "x.npz") as file:
        others = {key: file[key] for key in file.files if key != "sha256"}
        assert str(file["sha256"]) == content_digest(others)
    one = {"a": np.array([[1.0, 2.0]])}
    inner = hashlib.sha256(one["a"].tobytes()).digest()
    assert content_digest(one) == hashlib.sha256(b"a <f8 (1, 2)\n" + inner).hexdigest()
    # In blocks, whatever the number of threads.
    large = np.arange(3 * 2**19 + 5, dtype=float)
    parts = [large.tobytes()[at : at + 2**22] for at in range(0, large.nbytes, 2**22)]
    inner = b"".join(hashlib.sha256(part).digest() for part in parts)
    expected = hashlib.sha256(f"a <f8 {large.shape}\n".encode() + inner).hexdigest()
    assert content_digest({"a": large}) == expected


@pytest.mark.parametrize("ending", RECORDS)
def test_a_number_of_a_group_that_is_not_finite_is_refused(ending, tmp_path):
    path = tmp_path / f"x{ending}"
    with pytest.raises(fflin.InputError, match="second of figures is not finite"):
        write_record(
            path, {"figures": {"first": 1.0, "second": np.inf}}, checksummed=True
        )
    assert not path.exists()


def test_matlab_files_of_others_are_read(tmp_path):
    from scipy.io import savemat

    record = {
        "A": np.random.default_rng(2).normal(size=(3, 4)),
        "z": np.array([[1.0 + 1.0j, 2.0]]),
        "i": np.int16([[1], [-2]]),
        "text": "größe",
        "nothing": "",
        "rows": np.array(["ab", "cde"]),
        "cells": np.array(["one", "", "three"], dtype=object),
        "group": {"x": 1.5, "name": "n"},
    }
    for compressed in (False, True):
        savemat(tmp_path / "x.mat", record, do_compression=compressed)
        result, verified = read_record(tmp_path / "x.mat")
        assert not verified and set(result) == set(record)
        for key in ("A", "z", "i"):
            assert (
                result[key].shape == record[key].shape
                and (result[key] == record[key]).all()
            )
        assert (result["text"], result["nothing"]) == ("größe", "")
        assert result["rows"] == ["ab", "cde"] and result["cells"] == [
            "one",
            "",
            "three",
        ]
        assert result["group"]["x"].item() == 1.5 and result["group"]["name"] == "n"
    (tmp_path / "x.mat").write_bytes(bytes(124) + b"\0\2IM")
    with pytest.raises(fflin.FileError, match="save -v7"):
        fflin.Gain.load(tmp_path / "x.mat")


def test_plain_numpy_and_scipy_read_saved_files(tmp_path):
    from scipy.io import loadmat

    gain = made("gain")
    gain.save(tmp_path / "g.npz")
    gain.save(tmp_path / "g.mat")
    with np.load(tmp_path / "g.npz") as file:
        assert (file["K"] == gain.K).all() and tuple(
            file["state_names"]
        ) == gain.state_names
    mat = loadmat(tmp_path / "g.mat", simplify_cells=True)
    assert (mat["K"] == gain.K).all() and tuple(mat["state_names"]) == gain.state_names


def test_verified_is_kept_where_a_thing_is_changed(tmp_path):
    path = tmp_path / "x.json"
    made("model").save(path)
    unsealed(path)
    read = fflin.LinearModel.load(path)
    gain, estimator = fflin.lqr(read, 1.0, 1.0), fflin.kalman(read, 1.0, 1.0)
    sound = fflin.lqr(made("model"), 1.0, 1.0)
    made_of_it = (
        *(
            read.discretize(0.1),
            replace(read, u0=read.u0 + 1.0),
            fflin.momentum_reduction(read),
        ),
        *(gain, fflin.acceleration_lqr(read, 1.0, 1.0, 1.0), estimator),
        *(fflin.lqg(gain, made("estimator")), fflin.lqg(sound, estimator)),
        fflin.lqr_batch(replace(made("batch"), verified=False), 1.0, 1.0),
    )
    assert not any(item.verified for item in made_of_it)
    assert fflin.lqg(sound, made("estimator")).verified
    assert all(made(kind).verified for kind in FORMATS)


@pytest.mark.parametrize("kind", mostly(["model", "gain"], "model"))
def test_a_header_of_mat_that_is_nearly_sealed_is_refused(kind, tmp_path):
    path = tmp_path / "x.mat"
    made(kind).save(path)
    data = path.read_bytes()
    for bit in range(8 * 116):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        with any_wording(), pytest.raises(fflin.FileError):
            type(made(kind)).load(path)


def test_a_record_of_another_program_names_its_missing_fields(tmp_path):
    np.savez(tmp_path / "x.npz", a=1.0)
    with pytest.raises(fflin.FileError, match="'state_names'"):
        fflin.LinearModel.load(tmp_path / "x.npz")


def test_a_batch_that_is_not_held_against_its_digest_says_so(tmp_path):
    pytest.importorskip("h5py")
    for ending in (".npz", ".h5"):
        path = tmp_path / f"b{ending}"
        made("batch").save(path)
        assert fflin.LinearBatch.load(path).verified
        assert not fflin.LinearBatch.load(path, verify=False).verified


@pytest.mark.parametrize(
    ("content", "format_"),
    [
        (
            b"# Created by Octave 7.3.0\n# name: A\n# type: matrix\n",
            "Octave's own format",
        ),
        (b"Octave-1-L", "Octave's own format"),
        (b"\x89HDF\r\n\x1a\n", "HDF5 file"),
    ],
)
def test_other_formats_of_octave_and_matlab_are_reported_with_the_remedy(
    tmp_path, content, format_
):
    (tmp_path / "x.mat").write_bytes(content.ljust(200, b" "))
    with pytest.raises(fflin.FileError, match=rf"{format_}; save it with save -v7"):
        fflin.Gain.load(tmp_path / "x.mat")


def test_sparse_matrices_of_matlab_are_read(tmp_path):
    from scipy.io import savemat

    A = np.diag([1.0, 0.0, -2.0])
    savemat(tmp_path / "x.mat", {"A": scipy.sparse.csc_matrix(A)})
    result, _ = read_record(tmp_path / "x.mat")
    assert np.array_equal(result["A"], A)


# Values that programs, or attackers, may write in the place of an entry.
WRONG = {
    "number": 5,
    "pair": [1, 2],
    "ragged": [[1], [1, 2]],
    "word": "x",
    "nothing": None,
    "table": {"a": 1},
    "words": [[["x"]]],
    "deep": [[[1.0]]],
    "large": 1e308,
    "empty": [],
    "surrogate": "\udc80",
    "complex": {"real": [1], "imag": ["x"]},
    "tables": [{"a": 1}],
}


@pytest.mark.parametrize(
    "kind",
    ["trajectory", *(pytest.param(x, marks=pytest.mark.exhaustive) for x in OTHERS)],
)
def test_any_value_in_the_place_of_any_entry_is_refused_or_accepted(kind, tmp_path):
    path = tmp_path / "file.json"
    robot = fflin.load("astrobee_arm")
    thing = made("motion").trajectory(robot) if kind == "trajectory" else made(kind)
    thing.save(path)
    record, _ = read_record(path)
    wrong = []
    for key, kept in record.items():
        for name, value in WRONG.items():
            several = isinstance(kept, list) and len(kept) > 1
            for placed in [value, [*kept[:-1], value]] if several else [value]:
                path.write_text(json.dumps(record | {key: placed}))
                try:
                    if kind == "trajectory":
                        fflin.Trajectory.load(path, robot)
                    else:
                        str(type(thing).load(path))
                except fflin.FflinError:
                    pass
                except Exception as error:
                    wrong.append((key, name, placed is value, repr(error)))
    assert not wrong


def test_a_gain_whose_entries_contradict_each_other_is_refused(tmp_path):
    made("gain").save(tmp_path / "gain.json")
    record, _ = read_record(tmp_path / "gain.json")
    for change in (
        {"regulated": ["nosuch"]},
        {
            "state_names": [*record["state_names"][:-1], "x"],
            "regulated": record["state_names"],
        },
        {"poles": []},
    ):
        (tmp_path / "gain.json").write_text(json.dumps(record | change))
        with pytest.raises(fflin.FileError):
            fflin.Gain.load(tmp_path / "gain.json")


def test_files_are_not_unpacked_if_they_would_fill_the_memory(monkeypatch, tmp_path):
    from scipy.io import savemat

    zeros = np.zeros((400, 500))  # 1.6 MB, of which a file has some kB
    np.savez_compressed(tmp_path / "bomb.npz", D=zeros)
    savemat(tmp_path / "bomb.mat", {"D": zeros}, do_compression=True)
    lin = made("model")
    room = 2 * zeros.nbytes
    for name in ("bomb.npz", "bomb.mat"):
        assert (tmp_path / name).stat().st_size < 10_000
        for memory, message in (
            (room, "not fit into memory"),
            (room + 10_000, "500 inputs"),
        ):
            monkeypatch.setattr(
                "fflin.base.record.memory", lambda memory=memory: memory
            )
            with pytest.raises(fflin.FflinError, match=message):
                fflin.LinearController(tmp_path / name, lin)


def test_the_largest_mat_files_are_read_without_decompressing_them_whole(
    monkeypatch, tmp_path
):
    from scipy.io import savemat

    from fflin.base.record import _unpacked_size

    savemat(
        tmp_path / "a.mat", {"D": np.zeros(10**6), "E": np.ones(3)}, do_compression=True
    )
    content = (tmp_path / "a.mat").read_bytes()
    assert 8e6 < _unpacked_size(content) < 8.1e6
    monkeypatch.setattr("fflin.base.record.memory", lambda: 100)
    assert _unpacked_size(content) < 8e6
