"""Uncertain models in slycot and Octave, as docs/guide/uncertain_models.md describes."""

import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

import fflin
from tests.support.patience import finished

pytestmark = pytest.mark.docs

PAGE = (Path(__file__).parents[2] / "docs/guide/uncertain_models.md").read_text(
    encoding="utf-8"
)

# What of the toolbox the page needs, for one value of each delta.
TOOLBOX = {
    "ureal": "global delta at; at = at + 1; value = delta(at);",
    "ss": "value = struct('A', varargin{1}, 'B', varargin{2}, 'C', varargin{3}, 'D', varargin{4});",
    "lft": "Delta = varargin{1}; P = varargin{2}; n = size(Delta, 1); D = P.D(1:n, 1:n); "
    "G = P.B(:, 1:n)*Delta/(eye(n) - D*Delta); "
    "value = struct('A', P.A + G*P.C(1:n, :), 'B', P.B(:, n+1:end) + G*P.D(1:n, n+1:end));",
}


def blocks(language):
    """Return the blocks of a language before the section on sensitivity."""
    before = PAGE.split("## Sensitivity")[0]
    return re.findall(rf"```{language}\n(.*?)```", before, re.DOTALL)


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The folder of a reader who ran the page's Python, and what is left in the session."""
    pytest.importorskip("slycot")
    folder, names = tmp_path_factory.mktemp("reader"), {}
    before = os.getcwd()
    os.chdir(folder)
    try:
        exec("\n".join(blocks("python")), names)
    finally:
        os.chdir(before)
    return folder, names


@pytest.mark.exhaustive
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
def test_slycot_takes_the_model_of_the_page(followed):
    _, names = followed
    assert names["plant"].nstates == 30 and names["Z"].shape == 2 * (
        names["blocks"].sum(),
    )
    # At a delta of 1 / |mu| or less no pole is on the axis: that of the loop at w = 10.
    bound = names["ab13md"](names["Z"], names["blocks"], names["kinds"])[0]
    rng = np.random.default_rng(0)
    for delta in rng.uniform(-1.0, 1.0, (50, len(names["blocks"]))) / bound:
        A, B, *_ = names["lft"].at(delta)
        at = 10j * np.eye(len(A)) - A + B @ names["gain"].K
        assert np.linalg.svd(at, compute_uv=False)[-1] > 0.0
    assert 0.0 < bound < 1.0


@pytest.mark.process
@pytest.mark.filterwarnings("ignore::fflin.FflinWarning")
@pytest.mark.skipif(shutil.which("octave") is None, reason="octave is not installed")
def test_octave_takes_the_model_of_the_page(followed):
    folder, names = followed
    lft = fflin.LFT.load(folder / "uncertain.mat")
    plain, robust = blocks("matlab")
    for name, body in TOOLBOX.items():
        (folder / f"{name}.m").write_text(
            f"function value = {name}(varargin)\n{body}\nend\n"
        )
    delta = np.array([0.5, -0.3, 0.8, -1.0])
    given = plain.replace("delta(1) = 1;", f"delta = {delta.tolist()};")
    assert given != plain
    script = (
        f"global delta at; at = 0;\n{plain}first = struct('A', A, 'B', B);\n{given}"
        f"second = struct('A', A, 'B', B);\n{robust}"
        "save('-v6', 'out.mat', 'first', 'second', 'plant');\n"
    )
    (folder / "reader.m").write_text(script)
    done = finished(
        ["octave", "--no-gui", "--quiet", "--norc", "reader.m"],
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    result = loadmat(folder / "out.mat", squeeze_me=True)
    ends = {"first": np.array([1.0, 0.0, 0.0, 0.0]), "second": delta, "plant": delta}
    for name, row in ends.items():
        for got, expected in zip(
            (result[name]["A"], result[name]["B"]), lft.at(row), strict=False
        ):
            assert np.abs(got.item() - expected).max() < 1e-12 * np.abs(expected).max()
    assert names["lft"].parameters == lft.parameters
