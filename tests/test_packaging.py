"""Files for packages and for continuous integration agree with the project."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
yaml = pytest.importorskip("yaml")

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))[
    "project"
]
# Names on conda-forge of what has another name on PyPI.
CONDA = {
    "pin": "pinocchio",
    "meshcat": "meshcat-python",
    "example-robot-data-loaders": "example-robot-data",
}


def read(name):
    return yaml.safe_load((ROOT / name).read_text(encoding="utf-8"))


def test_the_conda_recipe_has_the_version_and_the_dependencies():
    recipe = read("conda/recipe.yaml")
    assert recipe["context"]["version"] == PROJECT["version"]
    wanted = set()
    for item in PROJECT["dependencies"]:
        name, bounds = re.match(r"([\w-]+)([^;]*)", item).groups()
        wanted.add(f"{CONDA.get(name, name)} {bounds.strip()}")
    python, *others = recipe["requirements"]["run"]
    assert python == f"python {PROJECT['requires-python']}"
    assert set(others) == wanted


def test_the_workflows_run_parts_that_exist_on_the_pythons_of_the_package():
    jobs = read(".github/workflows/ci.yml")["jobs"]
    pythons = [
        item.rpartition(" ")[2] for item in PROJECT["classifiers"] if ":: 3." in item
    ]
    assert jobs["tests"]["strategy"]["matrix"]["python"] == pythons
    parts = re.search(r'^known="(.*)"$', (ROOT / ".ci/run").read_text(), re.MULTILINE)[
        1
    ].split()
    run = [
        step["run"] for job in jobs.values() for step in job["steps"] if "run" in step
    ]
    run += jobs["complete"]["strategy"]["matrix"]["parts"]
    named = re.sub(r"\$\{\{.*?\}\}|\.ci/run", "", " ".join(run)).split()
    assert set(named) == set(parts)
    listed = re.search(
        r"all parts are (.*?) \|", (ROOT / "CONTRIBUTING.md").read_text()
    )[1]
    assert re.findall(r"`(\w+)`", listed) == parts
    assert read(".github/workflows/release.yml")["jobs"].keys() == {"build", "publish"}


def test_an_unknown_part_is_refused_before_anything_runs():
    done = subprocess.run(
        [ROOT / ".ci/run", "lin"], capture_output=True, text=True, check=False
    )
    assert (
        done.returncode == 2
        and "'lin' is not a part; give some of: readme" in done.stderr
    )
