"""`fflin sensitivity` and `fflin uncertain` as a user runs them."""

import json

import numpy as np
import pytest
from scipy.io import loadmat

import fflin
from tests.support.commands import refused, run


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_most_important_parameters_are_shown_and_saved(tmp_path):
    point = ("--joint", "joint_2=0.6", "--velocity", "omega_b.z=0.1")
    code, out, err = run(
        *("sensitivity", "servicer_7dof", *point, "--top", 4, "-o", tmp_path / "c.mat")
    )
    assert code == 0 and not err
    head, table = out.split("parameter ")
    _, *rows, more, message = table.splitlines()
    assert "most" in head and len(rows) == 4 and more.startswith("... and ")
    assert all(
        len(line) <= 80 for line in out.splitlines()[:-1]
    ) and message.startswith("wrote ")
    robot = fflin.load("servicer_7dof")
    q = fflin.configuration(robot, {"joint_2": 0.6})
    lin = fflin.linearize(robot, q, fflin.velocity(robot, {"omega_b.z": 0.1}))
    S = fflin.sensitivity(lin)
    file = loadmat(tmp_path / "c.mat", squeeze_me=True)
    assert [*file["parameters"]] == [*S.names]
    at = S.names.index("link_3.mass")
    assert file["units"][at] == "kg" and file["values"][at] == pytest.approx(9.5)
    for key in ("dA", "dB", "df0"):
        assert np.array_equal(
            file[key][at], getattr(S["link_3.mass"], key)
        ) or np.allclose(
            file[key][at], getattr(S["link_3.mass"], key), rtol=1e-12, atol=1e-15
        )
    assert np.array_equal(file["A"], lin.A) and file["frame"] == "hybrid"


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_some_alone_are_shown():
    code, out, _ = run("sensitivity", "servicer_7dof", "--only", "mass", "--top", 99)
    rows = out.split("B [%]\n")[1].splitlines()
    assert code == 0 and len(rows) == 10 and all(".mass " in row for row in rows)


def test_of_a_sampled_model_in_every_format(tmp_path):
    for ending in ("npz", "json"):
        code, *_ = run(
            "sensitivity", "cubesat", "--dt", 0.1, "-o", tmp_path / f"c.{ending}"
        )
        assert code == 0
    text = json.loads((tmp_path / "c.json").read_text())
    with np.load(tmp_path / "c.npz") as file:
        assert np.array_equal(np.array(text["dB"]), file["dB"]) and file["dt"] == 0.1
        S = fflin.sensitivity(fflin.linearize(fflin.load("cubesat")).discretize(0.1))
        assert np.allclose(file["dB"], S.dB, rtol=1e-12, atol=0.0)


@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_the_fraction_is_saved(tmp_path):
    vary = ("--vary", "base.mass=0.2", "--vary", "panel_left.stiffness=80:120")
    vary += ("--vary", "panel_*.damping=0.1:0.3,tied")
    path = tmp_path / "u.mat"
    code, out, err = run(
        "uncertain", "servicer_7dof", "--joint", "joint_2=0.6", *vary, "-o", path
    )
    assert code == 0 and not err and "Delta is 6 x 6" in out
    robot = fflin.load("servicer_7dof")
    ranges = {"base.mass": 0.2, "panel_left.stiffness": (80.0, 120.0)}
    ranges["panel_*.damping"] = {"range": (0.1, 0.3), "tied": True}
    expected = fflin.uncertain(robot, ranges).lft(
        fflin.configuration(robot, {"joint_2": 0.6})
    )
    saved = fflin.LFT.load(path)
    assert np.array_equal(saved.D11, expected.D11) and saved.repeats.tolist() == [
        3.0,
        1.0,
        2.0,
    ]


def test_errors_are_one_line(tmp_path):
    vary = ("uncertain", "cubesat", "--vary")
    assert "'bas.mass'" in refused(*vary, "bas.mass=0.1")
    assert "NAME=FRACTION" in refused(*vary, "base.mass")
    assert "NAME=FRACTION" in refused(*vary, "base.mass=1:2:3")
    assert "least < largest" in refused(*vary, "base.mass=3:2")
    assert "more than once" in refused(
        *vary, "base.mass=0.1", "--vary", "base.mass=0.2"
    )
    assert "--vary" in refused("uncertain", "cubesat")
    assert "base.mass" in refused(*vary, "base.mass=-3:1", "-o", tmp_path / "u.mat")
    assert "0.2 for 20 %" in refused(*vary, "base.mass=20", "-o", tmp_path / "u.mat")
    assert "'mas'" in refused("sensitivity", "cubesat", "--only", "mas")
    assert "gravity" in refused(*vary, "base.mass=0.1", "--gravity", "0", "0", "-9.8")
    assert "--top" in refused("sensitivity", "cubesat", "--top", "0")
    assert ".npz" in refused("sensitivity", "cubesat", "-o", tmp_path / "s.csv")
    assert "dt" in refused("sensitivity", "cubesat", "--dt", "-1")
    assert not list(tmp_path.iterdir())
