"""The benchmarks compare what is the same, and the README claims what they found."""

import builtins
import itertools
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fflin
from benchmarks import peers, tables, timing
from benchmarks.peers import WrongResultError, check, methods, pinocchio_peer
from benchmarks.robots import generated, is_rigid, load, plain_urdf, random_point
from tests.support.patience import finished

RESULTS = tables.RESULTS.read_text(encoding="utf-8")
README = tables.README.read_text(encoding="utf-8")
CASES = [("at_rest", True), ("at_point", False)]


def figures(text):
    """Every cell of the tables in a text."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return {cell.strip() for line in lines for cell in line.split("|")}


def test_every_ratio_of_the_readme_is_in_the_results():
    """In its tables, and in its prose: "12.3 times"."""
    before, _, rest = README.partition(tables.BEGIN)
    shown, _, after = rest.partition(tables.END)
    assert figures(shown) and figures(shown) <= figures(RESULTS)
    claimed = re.findall(r"(\d[\d.,]*\d|\d) times", before + after)
    assert set(claimed) <= figures(RESULTS)


@pytest.mark.parametrize(("what", "at_rest"), CASES)
@pytest.mark.parametrize("name", ["cubesat", "ets_vii", "servicer_7dof", "panda"])
def test_pinocchio_by_hand_agrees(name, what, at_rest):
    point = random_point(load(name))
    for method in getattr(pinocchio_peer, what)(point):
        assert check(method, point, at_rest=at_rest) < 1e-11


@pytest.mark.parametrize(("what", "at_rest"), CASES)
def test_peer_with_another_result_is_not_timed(what, at_rest):
    """Whichever one slope is wrong, and whether by its sign or by not being a number."""
    point = random_point(load("ur5"))
    (right,) = getattr(pinocchio_peer, what)(point)
    right.call()
    slopes = right.slopes()
    rows, columns = np.nonzero(
        np.abs(slopes) > 1e-2 * np.abs(slopes).max(axis=1)[:, None]
    )
    rng = np.random.default_rng(0)
    for k in rng.choice(len(rows), 20, replace=False):
        for factor in (-1.0, np.nan):
            wrong = slopes.copy()
            wrong[rows[k], columns[k]] *= factor
            with pytest.raises(WrongResultError, match=r"on ur5: differs"):
                check(
                    replace(right, slopes=lambda wrong=wrong: wrong),
                    point,
                    at_rest=at_rest,
                )


def test_peer_in_another_frame_is_detected():
    point = random_point(load("servicer_7dof"))
    (method,) = pinocchio_peer.at_point(point)
    for frame in ("hybrid", "world"):
        with pytest.raises(WrongResultError):
            check(replace(method, frame=frame), point, at_rest=False)


def test_peers_that_are_not_there_are_named(monkeypatch):
    missing = ("mujoco", "crocoddyl", "pydrake", "casadi")
    original_import = builtins.__import__

    def without(name, *rest):
        if name.partition(".")[0] in missing:
            raise ImportError(f"No module named '{name}'")
        return original_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", without)
    for name in peers.MODULES[1:]:
        monkeypatch.delitem(
            peers.importlib.sys.modules, f"benchmarks.peers.{name}", raising=False
        )
    result, notes = methods("at_rest", random_point(load("cubesat")))
    assert [method.name for method in result] == [pinocchio_peer.FLOOR]
    assert len(notes) == 4 and all("not installed" in note for note in notes)


@pytest.mark.parametrize("robot", ["servicer_7dof", "panda", "talos", "chain", "tree"])
def test_urdf_for_all_peers_is_the_same_robot(robot, tmp_path):
    robot = generated(robot, 12) if robot in ("chain", "tree") else load(robot)
    path = tmp_path / "plain.urdf"
    path.write_text(plain_urdf(robot))
    same = fflin.load(path)
    joints = dict(zip(robot.joint_names, random_point(robot).q_m, strict=True))
    M = fflin.linearize(robot, fflin.configuration(robot, joints)).M
    lin = fflin.linearize(same, fflin.configuration(same, joints))
    index = [same.joint_names.index(name) for name in robot.joint_names]
    order = [*range(6), *(6 + i for i in index)]
    assert lin.M[np.ix_(order, order)] == pytest.approx(
        M, rel=1e-12, abs=1e-12 * np.abs(M).max()
    )


def test_inertias_that_no_rigid_body_has_are_reported():
    assert not is_rigid(load("ets_vii")) and is_rigid(load("servicer_7dof"))


def test_other_load_of_the_machine_is_not_counted(monkeypatch):
    """Two functions that cost 2 and 3 ms, each disturbed in every third of its calls."""
    clock, calls = [0.0], itertools.count()

    def costs(seconds):
        def call():
            clock[0] += seconds if next(calls) % 3 else 20.0 * seconds

        return call

    monkeypatch.setattr(timing.time, "perf_counter", lambda: clock[0])
    times = timing.interleaved({"two": costs(2e-3), "three": costs(3e-3)})
    assert times["two"].least == pytest.approx(2e-3)
    assert times["three"].ratio(times["two"]) == pytest.approx(1.5)


@pytest.mark.process
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_command_prints_a_case():
    command = [sys.executable, "-m", "benchmarks"]
    done = finished(
        [*command, "memory"], cwd=tables.ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    row = next(line for line in done.stdout.splitlines() if line.startswith("| fflin "))
    imported, first = (float(cell) for cell in row.split("|")[2:4])
    assert 5.0 < imported < first
    done = finished(
        [*command, "speed"], cwd=tables.ROOT, capture_output=True, text=True
    )
    assert done.returncode == 2 and "CASE is one of at_rest, " in done.stderr


def test_table_lands_between_the_markers(monkeypatch, tmp_path):
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{tables.BEGIN}\nold\n{tables.END}\nafter\n")
    monkeypatch.setattr(tables, "README", Path(readme))
    rows = (("ur5", "1.50"), ("talos", tables.figure(None)))
    shown = tables.Table("Title", "About.", ("robot", "peer"), rows, in_readme=True)
    for _ in range(2):
        tables.insert_in_readme(
            [shown, replace(shown, title="Hidden", in_readme=False)], "cmd"
        )
    text = readme.read_text()
    assert text.startswith("before\n") and text.endswith("after\n")
    assert (
        "old" not in text
        and "Hidden" not in text
        and text.count("| ur5   | 1.50 |") == 1
    )
