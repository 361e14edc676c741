"""The sentences of fflin that the tests meet, all of them in tests/messages.json.

A test asserts the class of an error or a warning and one keyword of its sentence. While it runs,
`pytest.raises`, `pytest.warns` and `commands.run` note the whole sentence by `hear`; at its end the
sentences must be those of the snapshot. `pytest --write-messages` writes them to it: of tests that
passed, where a sentence changed, but not where an error has another class than before; and it
removes those of tests that are gone from a file that was collected whole.
"""

import contextlib
import json
import math
import re
import tempfile
from pathlib import Path

import pytest

import fflin
from tests.support import errors_page

COMMAND = "pytest --write-messages"
RAISES, WARNS = pytest.raises, pytest.warns
# What the test that runs has met so far.
HEARD = []

ROOT = Path(__file__).parents[2]
# What differs from machine to machine and from run to run, and what stands for it.
VARIES = [
    (r"/[^\s'\"]*?/pytest-of-[^/\s]+/pytest-\d+(/popen-gw\d+)?/[\w.-]+", "TMP"),
    (r"/[^\s'\"]*/site-packages", "PACKAGES"),
    (re.escape(str(ROOT)), "ROOT"),
    (re.escape(tempfile.gettempdir()) + r"/fflin-\w+", "TMP"),
    (re.escape(str(Path.home())), "HOME"),
    (r"[\d.,]+ [kMGTP]B\b", "SIZE"),
    (r"tcp://[\d.]+:\d+", "ADDRESS"),
    (r"\(choose from [^)]*\)", "(choose from CHOICES)"),
    # Texts of NumPy, and lists of SciPy's distributions, which depend on their versions.
    (r"\((This file contains|Cannot load file containing) pickled.*", "(PICKLED)"),
    (r"(no distribution of scipy\.stats named '\w+'; ).*", r"\1NAMES"),
    (r"(maximum recursion depth exceeded)[a-zA-Z ]*", r"\1"),
]
LONGEST = 400
NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")


def hear(text, kind=""):
    """Note a sentence of the test that runs, once for all its figures; return it as it was said."""
    noted = text.strip()
    for pattern, word in VARIES:
        noted = re.sub(pattern, word, noted)
    noted = f"{kind}: {noted}"[:LONGEST] if kind else noted[:LONGEST]
    if all(NUMBER.sub("", noted) != NUMBER.sub("", each) for each in HEARD):
        HEARD.append(noted)
    return text


def hear_lines(stderr):
    """Note the errors and warnings that a command wrote to stderr; return all that it wrote."""
    for line in stderr.splitlines():
        if line.startswith(("fflin: error: ", "fflin: warning: ")):
            hear(line)
    return stderr


@contextlib.contextmanager
def any_wording():
    """Note nothing of what is met inside, where sentences differ between processors."""
    before = HEARD.copy()
    yield
    HEARD[:] = before


def says(text, *keywords):
    """Whether a line of a report, or a few that follow each other, has all keywords; note it."""
    lines = text.splitlines()
    for many in range(1, 5):
        for k in range(len(lines)):
            part = " ".join(" ".join(lines[k : k + many]).split())
            if all(word in part for word in keywords):
                hear(part)
                return True
    return False


@contextlib.contextmanager
def raises(*arguments, **options):
    """Expect an error as `pytest.raises` does, and note the sentence of one that is fflin's."""
    __tracebackhide__ = True
    with RAISES(*arguments, **options) as caught:
        yield caught
    if isinstance(caught.value, fflin.FflinError):
        hear(str(caught.value), type(caught.value).__name__)


@contextlib.contextmanager
def warns(*arguments, **options):
    """Expect warnings as `pytest.warns` does, and note the sentences of those that are fflin's."""
    __tracebackhide__ = True
    with WARNS(*arguments, **options) as caught:
        yield caught
    for each in caught:
        if issubclass(each.category, fflin.FflinWarning):
            hear(str(each.message), each.category.__name__)


def same(one, other):
    """Whether two sentences agree, figures but for what differs between processors."""
    pairs = list(zip(NUMBER.split(one), NUMBER.split(other), strict=False))
    return len(NUMBER.split(one)) == len(NUMBER.split(other)) and all(
        x == y or (k % 2 and _close(x, y)) for k, (x, y) in enumerate(pairs)
    )


def _close(one, other):
    if one.isdigit() and other.isdigit():
        return False
    return math.isclose(float(one), float(other), rel_tol=0.02, abs_tol=1e-6)


def differences(noted, heard):
    """Return the lines that say where the sentences of a test are not those of the snapshot."""
    lines = []
    for k in range(max(len(noted), len(heard))):
        old = noted[k] if k < len(noted) else "(nothing)"
        new = heard[k] if k < len(heard) else "(nothing)"
        if not same(old, new):
            lines += [f"  noted: {old}", f"  heard: {new}"]
    return lines


def classes(sentences):
    """Return the class of each sentence, empty where it is a line of a command or a report."""
    return [re.match(r"(?:\w+(?:Error|Warning)(?=: ))?", said)[0] for said in sentences]


def merged(noted, heard, gone):
    """Return the snapshot with the sentences of the tests that ran, without tests that are gone."""
    whole = {test: said for test, said in noted.items() if test not in gone}
    for test, said in heard.items():
        if differences(whole.get(test, []), said):
            whole[test] = said
    return {test: said for test, said in whole.items() if said}


class Messages:
    """The plugin of a pytest session: hears each test, and compares or writes."""

    def __init__(self, config):
        self.config = config
        self.path = config.rootpath / "tests" / "messages.json"
        self.write = config.getoption("write_messages")
        self.noted = self.read()
        self.heard, self.gone, self.narrowed = {}, [], set()

    def read(self):
        return json.loads(self.path.read_text("utf-8")) if self.path.exists() else {}

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem):
        HEARD.clear()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pytest, "raises", raises)
            patch.setattr(pytest, "warns", warns)
            result = yield
        test = pyfuncitem.nodeid
        self.heard[test] = HEARD.copy()
        noted = self.noted.get(test, [])
        wrong = differences(noted, HEARD)
        if wrong and not self.write:
            head = f"sentences that differ from {self.path.name}; `{COMMAND}` writes them to it:"
            pytest.fail("\n".join([head, *wrong]), pytrace=False)
        if len(noted) == len(HEARD) and classes(noted) != classes(HEARD):
            del self.heard[test]
            head = (
                f"errors of another class; where that is meant, take the test out of {self.path}:"
            )
            pytest.fail("\n".join([head, *wrong]), pytrace=False)
        return result

    def pytest_deselected(self, items):
        self.narrowed |= {_file(item.nodeid) for item in items}

    def pytest_collection_finish(self, session):
        tests = {item.nodeid for item in session.items}
        chosen = any("::" in str(each) for each in self.config.args)
        whole = set() if chosen else {_file(test) for test in tests} - self.narrowed
        self.gone = [
            test
            for test in self.noted
            if (_file(test) in whole and test not in tests)
            or not (self.config.rootpath / _file(test)).exists()
        ]

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.heard |= getattr(node, "workeroutput", {}).get("heard", {})
        self.gone += getattr(node, "workeroutput", {}).get("gone", [])

    def pytest_sessionfinish(self):
        if hasattr(self.config, "workeroutput"):
            self.config.workeroutput |= {"heard": self.heard, "gone": self.gone}
        elif self.write:
            whole = merged(self.read(), self.heard, self.gone)
            text = json.dumps(whole, indent=1, sort_keys=True, ensure_ascii=False)
            self.path.write_text(text + "\n", encoding="utf-8")
            errors_page.write(self.heard)


def _file(test):
    return test.partition("::")[0]


def pytest_addoption(parser):
    parser.addoption(
        "--write-messages",
        action="store_true",
        help="write the sentences that the tests meet to tests/messages.json and docs/errors.md",
    )


def pytest_configure(config):
    if config.getoption("basetemp"):
        VARIES.append((rf"{re.escape(config.getoption('basetemp'))}/[\w.-]+", "TMP"))
    config.pluginmanager.register(Messages(config), "messages")
