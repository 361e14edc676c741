"""The list of public names, and what an import pays for."""

import pydoc
import sys

import pytest

import fflin
from tests.support.patience import finished

pytestmark = pytest.mark.process


def imported_by(code: str) -> set[str]:
    """Modules that a new interpreter holds after running the code."""
    code += "\nimport sys; print('modules:', *sys.modules)"
    done = finished(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    return set(done.stdout.rpartition("modules:")[2].split())


def after(words: str) -> set[str]:
    """Modules that the command line has loaded after a command."""
    run = f"main({words.split()})"
    return imported_by(
        f"from fflin.__main__ import *\nfrom fflin.commands.cli import main\n"
        f"try: {run}\nexcept SystemExit: pass"
    )


def test_every_public_name_resolves_and_is_documented():
    for name in fflin.__all__:
        assert getattr(fflin, name).__doc__, name
    assert set(fflin.__all__) <= set(dir(fflin))
    assert not hasattr(fflin, "nothing")


@pytest.mark.process
def test_import_pays_for_nothing_heavy():
    heavy = {"scipy", "meshcat", "matplotlib", "control", "example_robot_data"}
    assert not imported_by("import fflin") & (heavy | {"numpy", "pinocchio"})
    main_job = (
        "import fflin; fflin.check(r := fflin.load('ets_vii'), fflin.linearize(r))"
    )
    assert not imported_by(main_job) & heavy
    assert not after("--help") & (heavy | {"numpy", "pinocchio"})
    # Neither does a command pay for what others need; each of these takes a millisecond and more.
    heavy |= {
        "numpy.ma",
        "numpy.testing",
        "numpy.typing",
        "subprocess",
        "tempfile",
        "html",
    }
    heavy |= {"numba", "fflin.commands.control"}
    moving = "linearize servicer_7dof --stiffness panel_left=9 --velocity omega_b.z=0.1"
    for words in ("linearize ets_vii", moving, "check ets_vii", "info ets_vii"):
        assert after(words) & (heavy | {"pinocchio"}) == {"pinocchio"}, words
    # at rest nothing vibrates
    assert "fflin.analysis.modes" not in after("linearize ets_vii")
    assert not after("robots") & (heavy - {"example_robot_data", "subprocess", "html"})


def test_help_begins_with_the_public_names_each_under_one_title():
    message = pydoc.plain(pydoc.render_doc(fflin))
    first = message.partition("PACKAGE CONTENTS")[0]
    assert max(map(len, first.splitlines())) <= 100
    listed = [name for line in first.splitlines() for name in line.strip().split(", ")]
    for name in fflin.__all__:
        assert listed.count(name) == 1, name
    titles = [
        line.strip() for line in fflin.__doc__.splitlines()[1:] if line[:1].strip()
    ]
    assert titles[0] == "Robots" and {"Control", "Figures", "Errors"} <= set(titles)


def test_completion_offers_public_names_alone():
    offered = {
        name
        for name in dir(fflin)
        if not (name.startswith("__") and name.endswith("__"))
    }
    assert offered == set(fflin.__all__)


def test_help_of_linearize_fits_a_screen():
    message = pydoc.plain(pydoc.render_doc(fflin.linearize)).splitlines()[2:]
    assert len(message) <= 50
    signature, *rest = message
    assert max(map(len, rest)) <= 88
    assert len(signature) <= 112  # all nine arguments, in one line
    assert ":" not in signature and "->" not in signature  # the types stand below
