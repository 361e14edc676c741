"""Names of signals in python-control, which has no dots: each is one signal, or an error."""

import itertools

import numpy as np
import pytest

import fflin
from fflin.linear.model import state_space
from tests.support.robots import LINKS, MIMIC

control = pytest.importorskip("control")


def gripper(path, a, b):
    """A gripper whose joints have the given names."""
    text = MIMIC.format(
        links=LINKS, a="revolute", b="revolute", parent="base", mimic=""
    )
    text = text.replace('joint name="a"', f'joint name="{a}"')
    path.write_text(text.replace('joint name="b"', f'joint name="{b}"'))
    return fflin.load(path)


def test_a_signal_picked_by_its_label_is_that_signal(tmp_path):
    lin = fflin.linearize(gripper(tmp_path / "g.urdf", "left.finger", "left_thumb"))
    system = lin.to_control()
    s = 0.5j
    for at, inputs in itertools.product((0, 6, 7, -1), (0, 6, 7)):
        output, name = system.output_labels[at], system.input_labels[inputs]
        assert output == lin.output_names[at].replace(".", "_")
        np.testing.assert_allclose(
            system[output, name](s), system(s)[at, inputs], rtol=1e-12
        )


def test_signals_with_one_label_are_an_error_everywhere(tmp_path):
    robot = gripper(tmp_path / "g.urdf", "a.b", "a_b")
    lin = fflin.linearize(robot)
    gain, seen = fflin.lqr(lin), fflin.kalman(lin, 1e-3, 1e-3)
    uncertain = fflin.uncertain(robot, {"base.mass": 0.1}).lft()
    for made in (
        lin,
        lin.discretize(0.1),
        gain,
        seen,
        fflin.lqg(gain, seen),
        uncertain,
    ):
        with pytest.raises(
            fflin.InputError, match=r"'\w+\.a\.b' and '\w+\.a_b' .* rename"
        ):
            made.to_control()
    assert len({*lin.state_names}) == 16 and lin.to_scipy().A.shape == (16, 16)


def test_no_two_signals_of_one_kind_share_a_label():
    matrices = np.eye(2), np.eye(2), np.eye(2), np.zeros((2, 2))
    system = state_space(matrices, 0.0, ("a.b", "c"), ("a.b", "c"), ("c", "a.b"))
    assert system.output_labels == ["c", "a_b"]
    for at in range(3):
        signals = [("a", "b")] * 3
        signals[at] = ("a", "a")
        with pytest.raises(fflin.InputError, match="'a' and 'a'"):
            state_space(matrices, 0.0, *signals)


def test_a_controller_whose_names_fit_two_signals_is_refused(tmp_path):
    lin = fflin.linearize(gripper(tmp_path / "g.urdf", "a.b", "a_b"))
    gain = np.array([[-2.0]])
    for inputs, outputs, error in (
        ("q_m_a_b", "tau_b_x", r"'q_m_a_b' .* 'q_m\.a\.b' and 'q_m\.a_b'"),
        ("q_b_x", "tau_m_a_b", r"'tau_m_a_b' .* 'tau_m\.a\.b' and 'tau_m\.a_b'"),
    ):
        system = control.ss([], [], [], gain, inputs=[inputs], outputs=[outputs])
        with pytest.raises(fflin.InputError, match=error):
            fflin.LinearController(system, lin)
    # The names of the model itself are always clear, and so are those of other joints.
    for dotted in ("a.b", "a_b"):
        given = Named(gain, (f"q_m.{dotted}",), (f"tau_m.{dotted}",))
        D = fflin.LinearController(given, lin).system.D
        at = (
            lin.input_names.index(f"tau_m.{dotted}"),
            lin.output_names.index(f"q_m.{dotted}"),
        )
        assert D[at] == -2.0 and np.count_nonzero(D) == 1
    system = control.ss([], [], [], gain, inputs=["q_b_x"], outputs=["tau_b_x"])
    assert fflin.LinearController(system, lin).system.D[0, 0] == -2.0


class Named:
    """A gain with the names of its signals."""

    A = B = C = np.zeros((0, 0))
    dt = 0.0

    def __init__(self, D, inputs, outputs):
        self.D, self.input_names, self.output_names = D, inputs, outputs
