"""Craig-Bampton superelements from files, which are written here by pyYeti."""

import os
from pathlib import Path

import numpy as np
import pytest

import fflin
from fflin.base.errors import FflinWarning, FileError, InputError
from fflin.base.writing import files_of_command

with np.printoptions():  # which pyYeti changes
    nastran = pytest.importorskip("pyyeti.nastran")

GRIDS = np.array([[1.0, 0.2, 0.0], [1.0, -0.3, 0.4], [1.1, 0.0, -0.2]])
# Output axes of the grids: basic, turned rectangular, and cylindrical about z.
TURNED = np.array(
    [[7, 1, 0], [0.3, 0.1, 0.0], [0.3, 1.1, 0.2], [1.2, 0.1, 0.0]], dtype=float
)
ROUND = np.array(
    [[8, 2, 0], [0.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], dtype=float
)


def structure(seed=1, modes=5):
    """Free-floating structure: grids, and many point masses on springs to a rigid frame.

    Return its rigid inertia and participation about the basic origin, squares of the clamped
    frequencies, and a function of the boundary's rigid motions that gives M and K of its
    Craig-Bampton model.
    """
    rng = np.random.default_rng(seed)
    rigid_mass = np.zeros((6, 6))
    for mass, point in zip(
        rng.uniform(2.0, 4.0, 30), rng.normal(size=(30, 3)), strict=True
    ):
        x, y, z = point
        at = np.hstack((np.eye(3), [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]))
        rigid_mass += mass * at.T @ at
    L = np.linalg.cholesky(rigid_mass) @ (
        0.3 * rng.normal(size=(6, modes)) / np.sqrt(modes)
    )
    squares = np.sort(rng.uniform(1.0, 400.0, modes))
    # Modes of another basis, which need not have unit modal mass.
    basis = rng.normal(size=(modes, modes)) + 2.0 * np.eye(modes)

    def matrices(motions):
        size = len(motions)
        M, K = (
            np.zeros((size + modes, size + modes)),
            np.zeros((size + modes, size + modes)),
        )
        # Spread over the grids so that the rigid motions sum it up again.
        spread = motions @ np.linalg.inv(motions.T @ motions)
        M[:size, :size] = spread @ rigid_mass @ spread.T
        M[:size, size:] = spread @ L @ basis
        M[size:, :size] = M[:size, size:].T
        M[size:, size:] = basis.T @ basis
        K[size:, size:] = basis.T @ np.diag(squares) @ basis
        elastic = np.eye(size) - spread @ motions.T
        K[:size, :size] = 50.0 * elastic @ elastic.T
        return M, K

    return rigid_mass, L, squares, matrices


@pytest.fixture
def files(tmp_path):
    """Files of a structure: op4 and asm; and what it is."""
    rigid_mass, L, squares, matrices = structure()
    uset = nastran.addgrid(None, [3, 11, 19], "b", 0, GRIDS, [0, TURNED, ROUND])
    M, K = matrices(nastran.rbgeom_uset(uset))
    nastran.bulk.wtextseout(
        str(tmp_path / "array"),
        se=101,
        bset=np.arange(18),
        uset=uset,
        spoint1=1001,
        namelist=["kaa", "maa"],
        kaa=K,
        maa=M,
    )
    return tmp_path / "array.op4", tmp_path / "array.asm", (rigid_mass, L, squares)


def shifted(rows, point):
    """Participation or inertia rows about a point, from those about the origin."""
    x, y, z = point
    shift = np.eye(6)
    shift[:3, 3:] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    return shift.T @ rows


def test_superelement_is_reduced_to_its_rigid_interface(files):
    op4, asm, (rigid_mass, L, squares) = files
    array = fflin.FlexibleAppendage.from_nastran(op4, asm, frame="base", name="array")
    center = GRIDS.mean(axis=0)
    assert array.frequency == pytest.approx(np.sqrt(squares) / (2.0 * np.pi), rel=1e-7)
    expected = shifted(L, center)
    result = np.vstack((array.translation, array.rotation))
    signs = np.sign((result * expected).sum(axis=0))
    assert result * signs == pytest.approx(expected, rel=1e-6, abs=1e-6)
    about = shifted(shifted(rigid_mass, center).T, center)
    assert array.inertia == pytest.approx(about, rel=1e-6, abs=1e-6 * about.max())
    text = str(array)
    assert "array_mode_5" in text and "clamped at frame 'base'" in text
    rows = {line.split()[0]: line.split() for line in text.splitlines() if line}
    residual = (array.inertia - result @ result.T).diagonal()
    assert [float(x) for x in rows["residual"][1:]] == pytest.approx(
        residual, rel=1e-3, abs=1e-9
    )
    assert max(map(len, text.splitlines())) <= 80


def test_units_origin_and_number_of_modes_are_as_told(files):
    op4, asm, _ = files
    read = fflin.FlexibleAppendage.from_nastran
    meters = read(op4, asm, frame="base", origin=(0.5, 0, 0), modes=2)
    millimeters = read(
        op4,
        asm,
        frame="base",
        origin=(0.5e-3, 0, 0),
        length="mm",
        mass="tonne",
        modes=2,
    )
    assert len(meters.frequency) == 2
    assert millimeters.translation == pytest.approx(
        np.sqrt(1e3) * meters.translation, rel=1e-9
    )
    assert millimeters.rotation == pytest.approx(
        np.sqrt(1e3) * 1e-3 * meters.rotation, rel=1e-9
    )
    assert millimeters.inertia[3:, 3:] == pytest.approx(
        1e-3 * meters.inertia[3:, 3:], rel=1e-9
    )
    for wrong in (
        {"length": "yd"},
        {"mass": 3},
        {"modes": 9},
        {"modes": 0},
        {"origin": (1, 2)},
    ):
        with pytest.raises((InputError, fflin.UnknownNameError)):
            read(op4, asm, frame="base", **wrong)


def test_a_link_that_differs_from_the_file_is_reported_and_may_be_replaced(files):
    op4, asm, (rigid_mass, _, _) = files
    robot = fflin.load("planar_detumble")
    read = fflin.FlexibleAppendage.from_nastran
    with pytest.warns(
        FflinWarning, match="correct the URDF, or use the inertia of the file"
    ):
        robot.replace(appendages=[read(op4, asm, frame="base", name="array")])
    taken = robot.replace(
        appendages=[read(op4, asm, frame="base", name="array", rigid=True)]
    )
    base = robot.links["base"].mass
    assert taken.mass == pytest.approx(robot.mass - base + rigid_mass[0, 0], rel=1e-6)
    assert fflin.check(taken, fflin.linearize(taken)).ok
    assert taken.links["base"].mass == pytest.approx(rigid_mass[0, 0], rel=1e-6)
    again = taken.replace(appendages=taken.appendages, inputs=taken.inputs)
    assert again.mass == pytest.approx(taken.mass, rel=1e-12)
    heavier = taken.with_mass_properties({"base": {"mass": 700.0}})
    others = sum(link.mass for name, link in robot.links.items() if name != "base")
    assert heavier.mass == pytest.approx(700.0 + others, rel=1e-9)
    twice = [
        read(op4, asm, frame="base", name=name, rigid=True) for name in ("one", "two")
    ]
    with pytest.raises(InputError, match="'two' is the second appendage"):
        robot.replace(appendages=twice)


def test_an_invalid_superelement_is_refused(files, tmp_path):
    op4, asm, _ = files
    read = fflin.FlexibleAppendage.from_nastran
    text = tmp_path / "text.asm"
    text.write_text("no cards\n")
    cut = tmp_path / "cut.op4"
    cut.write_bytes(op4.read_bytes()[:2000])
    empty = tmp_path / "empty.op4"
    empty.write_bytes(b"")
    for wrong in (
        (cut, asm), (empty, asm), (asm, asm), (op4, text), (op4, op4),
    ):  # fmt: skip
        with pytest.raises(InputError):
            read(*wrong, frame="base")
    with pytest.raises(FileError, match="No such file"):
        read(op4, tmp_path / "none.asm", frame="base")


def test_matrices_of_another_kind_are_refused(files, tmp_path):
    op4, asm, _ = files
    result = {name: matrix for name, matrix in nastran.op4.read(str(op4)).items()}
    M, K = result["maa"], result["kaa"]
    coupled, grounded, lopsided, free = K.copy(), K.copy(), M.copy(), K.copy()
    coupled[0, -1] = coupled[-1, 0] = 10.0
    grounded[0, 0] += 100.0
    lopsided[0, 3] += 1.0
    free[18:, 18:] = 0.0
    for k, m, message in (
        (coupled, M, "couples boundary and modes"),
        (grounded, M, "resists a rigid motion"),
        (K, lopsided, "symmetric"),
        (K[:-1, :-1], M[:-1, :-1], "22, 22"),
        (free, M, "not positive definite"),
        (K, -M, "not positive definite"),
        (K * np.nan, M, "finite"),
    ):
        path = tmp_path / "wrong.op4"
        nastran.op4.write(str(path), {"kaa": k, "maa": m})
        with pytest.raises(InputError, match=message):
            fflin.FlexibleAppendage.from_nastran(path, asm, frame="base")
    nastran.op4.write(str(path), {"kgg": K, "maa": M})
    with pytest.raises(InputError, match="no stiffness matrix"):
        fflin.FlexibleAppendage.from_nastran(path, asm, frame="base")


def test_included_files_and_the_punch_file_are_inputs(files, tmp_path):
    op4, asm, _ = files
    lines = asm.read_text().splitlines(keepends=True)
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "rest.inc").write_text("".join(lines[2:]))
    split = tmp_path / "split.asm"
    split.write_text("".join(lines[:2]) + "INCLUDE 'sub/\nrest.inc' $ the others\n")
    split.with_suffix(".pch").write_bytes(asm.with_suffix(".pch").read_bytes())
    read = fflin.FlexibleAppendage.from_nastran
    whole, parts = (read(op4, path, frame="base") for path in (asm, split))
    assert (whole.frequency == parts.frequency).all()
    assert (whole.participation == parts.participation).all()
    link = tmp_path / "link.json"
    for target in (
        tmp_path / "sub" / "rest.inc",
        split.with_suffix(".pch"),
        split,
        op4,
    ):
        link.unlink(missing_ok=True)
        link.symlink_to(target)
        with (
            files_of_command([], [link]),
            pytest.raises(FileError, match="is the input file"),
        ):
            read(op4, split, frame="base")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes")
def test_pipes_devices_and_endless_lists_are_refused_at_once(files, tmp_path):
    op4, asm, _ = files
    read = fflin.FlexibleAppendage.from_nastran
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    text = asm.read_text()
    wrong = tmp_path / "wrong.asm"
    for path in (pipe, Path("/dev/zero")):
        with pytest.raises(FileError, match="not a regular file"):
            read(path, asm, frame="base")
        with pytest.raises(FileError, match="not a regular file"):
            read(op4, path, frame="base")
        wrong.write_text(f"{text}include '{path}'\n")
        with pytest.raises(FileError, match="not a regular file"):
            read(op4, wrong, frame="base")
    wrong.write_text(f"{text}include 'wrong.asm'\n")
    with pytest.raises(InputError, match="includes itself"):
        read(op4, wrong, frame="base")
    for points in (
        "SPOINT 1001 THRU99999999",
        "SPOINT,1001,THRU,99999999",
        "spoint  1001    thru    +A1\n+A1     99999999",
    ):
        wrong.write_text(f"{text}{points}\n")
        with pytest.raises(InputError, match=r"99,99\d,\d{3} points"):
            read(op4, wrong, frame="base")
    asm.with_suffix(".pch").unlink()
    asm.with_suffix(".pch").symlink_to(pipe)
    with pytest.raises(FileError, match="not a regular file"):
        read(op4, asm, frame="base")
