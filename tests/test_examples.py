"""Every public name has an example, which runs as it stands in its docstring."""

import doctest
import inspect

import numpy as np
import pytest

import fflin
from tests.support.c_code import needs_compiler
from tests.support.marks import exhaustive

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


# Examples that fly many runs, search long or draw large figures.
LONG = {
    "plot_funnel",
    "Funnel",
    "funnel",
    "plan",
    "plot_validity",
    "validity",
    "Validity",
}
LONG |= {"plot_campaign", "monte_carlo", "plot_loops", "plot_matrices", "plot_motion"}
LONG |= {"Pointing", "PointingError", "CampaignPointing"}
COMPILED = {"CLaw"}  # examples that call a C compiler
NAMES = [
    *(name for name in fflin.__all__ if name not in LONG | COMPILED),
    *(pytest.param(name, marks=needs_compiler) for name in sorted(COMPILED)),
    *exhaustive(*sorted(LONG)),
]


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_a_public_name_runs(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    text = inspect.getdoc(getattr(fflin, name))
    assert "\nExamples\n--------\n" in text, f"{name} has no section Examples"
    example = doctest.DocTestParser().get_doctest(
        text,
        {"fflin": fflin, "np": np},
        name,
        inspect.getsourcefile(getattr(fflin, name)),
        0,
    )
    # Nothing may be skipped, and an example that begins nowhere shows nothing.
    assert example.examples and not any(
        "doctest:" in item.source for item in example.examples
    )
    assert any("fflin" in item.source for item in example.examples)
    message = []
    failed, _ = doctest.DocTestRunner(optionflags=FLAGS).run(
        example, out=message.append
    )
    assert not failed, "".join(message)
