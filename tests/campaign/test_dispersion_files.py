"""Files of dispersions: what they say, and file and line of what is wrong."""

import pickle

import pytest
from scipy import stats

import fflin


def read(tmp_path, text, head="[dispersions]\n"):
    path = tmp_path / "uncertain.toml"
    path.write_text(head + text)
    return fflin.load_dispersions(path)


def test_all_kinds_of_spreads(tmp_path):
    found = read(
        tmp_path,
        "q_b = 0.05\n"
        "r_b = {normal = 2}\n"
        '"*.mass" = {uniform = [-0.1, 0.2]}\n'
        "base.com = 0.1\n"
        "tau_b.x.fails = {values = [1, 2.5]}\n"
        'omega_b = {distribution = "t", df = 4, scale = 0.01}\n'
        "[dispersions.q_m]\n"
        "joint_1 = {uniform = [0, 0]}\n",
    )
    omega = found.pop("omega_b")
    assert dict(found) == {
        "q_b": 0.05,
        "r_b": 2,
        "*.mass": (-0.1, 0.2),
        "base.com": 0.1,
        "tau_b.x.fails": [1, 2.5],
        "q_m.joint_1": (0, 0),
    }
    assert omega.ppf(0.9) == pytest.approx(stats.t(4, scale=0.01).ppf(0.9), rel=1e-14)
    assert pickle.loads(pickle.dumps(found)) == found


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("q_b = [1, 2]", 3, r"'q_b': \[1, 2\] is no spread, expected .*{uniform = "),
        ("q_b = true", 3, "'q_b': True is no spread"),
        ("q_b = inf", 3, "is no spread"),
        ("q_b = {}", 3, "is no spread"),
        ("q_b = {uniform = [1, 2, 3]}", 3, "is no spread"),
        ("q_b = {uniform = [1, 2], c = 3}", 3, "is no spread"),
        ("q_b = {uniform = 1}", 3, "is no spread"),
        ("q_b = {normal = [1]}", 3, "is no spread"),
        ("q_b = {values = []}", 3, "is no spread"),
        ("q_b = {unifrom = [1, 2]}", 3, "'q_b.unifrom'.* is no spread"),
        ("q_b = {distribution = 3}", 3, "is no spread"),
        ('q_b = {distribution = "trang"}', 3, "no distribution .* 'trang'; did you mean triang"),
        ('q_b = {distribution = "triang"}', 3, "missing .* 'c'; it takes c, loc, scale"),
        ('q_b = {distribution = "norm", d = 1}', 3, "unexpected .* 'd'; it takes loc, scale"),
        ('q_b = {distribution = "triang", c = 7}', 3, "is none with c = 7"),
        ('q_b = {distribution = "norm", scale = "a"}', 3, "distribution norm"),
        ("q_b = -1", 3, "standard deviation of 0 or more"),
        ("\nq_b = {uniform = [1, 0]}", 4, r"\(1, 0\), expected \(least, largest\)"),
        ("nosuch = 1", 3, "no state to disperse named 'nosuch'"),
        ("nosuch.mass = 1", 3, "no mass to disperse named 'nosuch'"),
        ('\n"*.mass" = 0.9', 4, "'(base|joint_.)mass' is drawn as|no robot is made"),
        ("base.inertia = {uniform = [-2, 0]}", 3, "'base.inertia.x' is drawn as"),
        ("tau_b.gain = 1\nq_b.sensor = 0.1", 4, "no sensors"),
        ("q_b = 0.6", 1, "a start is drawn that is no attitude"),
    ],
)
def test_what_is_wrong_has_file_and_line(tmp_path, robots, text, line, said):
    with pytest.raises(fflin.FflinError, match=said) as caught:
        given = read(tmp_path, "r_b = 0.01\n" + text)
        fflin.monte_carlo(robots["planar_detumble"], None, given, runs=100, duration=0.1)
    assert str(caught.value).startswith(f"{tmp_path / 'uncertain.toml'}:{line}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ("", 1, "holds no spreads; write"),
        ("[dispersions]", 1, "holds no spreads"),
        ("dispersions = 3", 1, "holds no spreads"),
        ("\nq_b = 0.1", 2, "no table named 'q_b'; there are: dispersions; write"),
        ("[dispersions]\nq_b = 1\n[input]\nx = 1", 3, "no table named 'input'"),
        ("[dispersions]\nq_b = ", 2, "not TOML"),
        ("[dispersions]\nq_b = 1\nq_b.sensor = 1", 3, 'dots stand in quotes, "q_b.sensor"'),
    ],
)
def test_what_is_no_such_file(tmp_path, text, line, said):
    with pytest.raises(fflin.FflinError, match=said) as caught:
        read(tmp_path, text, head="")
    assert f"uncertain.toml:{line}: " in str(caught.value)


def test_errors_about_other_things_name_no_file(tmp_path, robots):
    given = read(tmp_path, "q_b = 0.01")
    with pytest.raises(fflin.InputError, match=r"^runs is 0"):
        fflin.monte_carlo(robots["planar_detumble"], None, given, runs=0, duration=0.1)
