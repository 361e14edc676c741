"""The picture of the rooms is that of the code, and the stub that of the public names."""

import ast
import re
import runpy
from pathlib import Path

import fflin

DOCS = Path(__file__).parents[1] / "docs"


def test_the_picture_is_made_from_the_code_and_no_import_runs_up():
    rooms = runpy.run_path(str(DOCS / "scripts" / "rooms.py"))
    picture = rooms["drawing"]()
    assert (DOCS / "rooms.svg").read_text(encoding="utf-8") == picture, (
        "run python docs/scripts/rooms.py"
    )
    assert 'class="up"' not in picture
    assert len(rooms["rooms"]()) == 15


def test_the_page_names_modules_and_files_that_exist():
    page = (DOCS / "architecture.md").read_text(encoding="utf-8")
    package = Path(fflin.__file__).parent
    rooms = "|".join(runpy.run_path(str(DOCS / "scripts" / "rooms.py"))["rooms"]())
    modules = set(re.findall(rf"`((?:{rooms})(?:\.\w+)+)`", page))
    assert len(modules) > 80
    assert not [
        m for m in modules if not (package / f"{m.replace('.', '/')}.py").is_file()
    ]
    files = set(re.findall(r"`([\w./]+/\w*\.?(?:pyi?|toml)?)`", page))
    assert len(files) > 40
    places = package, DOCS.parent
    assert not [
        f for f in files - {"tests/ROOM"} if not any((p / f).exists() for p in places)
    ]


def test_the_stub_has_the_names_and_modules_of_the_package():
    tree = ast.parse(Path(fflin.__file__).with_suffix(".pyi").read_text())
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    # In a stub a name is public where it is imported as itself.
    names = {
        alias.asname
        for node in imports
        for alias in node.names
        if alias.asname == alias.name
    }
    assert names == set(fflin.__all__)
    modules = {alias.name: node.module for node in imports for alias in node.names}
    assert modules == {
        name: f"fflin.{module}" for name, module in fflin._MODULES.items()
    }
    for name, module in modules.items():
        assert getattr(fflin, name).__module__ == module


def test_the_package_and_its_citation_have_the_same_version():
    root = Path(__file__).parents[1]
    project = (root / "pyproject.toml").read_text(encoding="utf-8")
    citation = (root / "CITATION.cff").read_text(encoding="utf-8")
    start = (root / "docs" / "start.md").read_text(encoding="utf-8")
    result = [
        re.search(r'^version = "(.*)"$', project, re.M),
        re.search(r"^version: (.*)$", citation, re.M),
        re.search(r"^  version = \{(.*)\},$", start, re.M),
    ]
    assert [match and match[1] for match in result] == [fflin.__version__] * 3


def test_no_constant_of_a_module_replaces_another_with_the_same_name():
    package = Path(fflin.__file__).parent
    twice = []
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        names = [
            target.id
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        ]
        twice += [(path.name, name) for name in names if names.count(name) > 1]
    assert not twice
