"""What every message keeps to: one line, of a length that is read."""

import warnings

import pytest

import fflin
from fflin.base.errors import one_line


@pytest.mark.parametrize(
    "kind", [fflin.FflinError, fflin.UrdfError, fflin.FflinWarning]
)
def test_messages_are_one_line_whatever_names_hold(kind):
    assert str(kind("no joint named 'a\nb\r\x85\u2028\x1b[2J'")) == (
        r"no joint named 'a\nb\r\x85\u2028\x1b[2J'"
    )


def test_a_long_name_keeps_both_ends_and_a_path_is_whole():
    message = one_line(f"no joint named 'first{'x' * 5000}last'; known names: joint_1")
    assert message.startswith("no joint named 'firstxxx") and message.endswith(
        "; known names: joint_1"
    )
    assert "xlast'" in message and len(message) < 110
    path = "/".join(20 * ["a_folder_of_many"]) + "/robot.urdf"
    assert one_line(f"no file at '{path}'") == f"no file at '{path}'"


def test_a_message_of_many_words_is_cut_too():
    message = one_line(f"begin {'x y ' * 5000}end")
    assert (
        message.startswith("begin x y")
        and message.endswith("y end")
        and len(message) < 1010
    )


def test_a_warning_is_shown_in_one_line():
    with warnings.catch_warnings(record=True) as result:
        warnings.simplefilter("always")
        warnings.warn("link 'a\nb' moves", fflin.FflinWarning, stacklevel=1)
    assert str(result[0].message) == r"link 'a\nb' moves"
