"""The sentences of fflin that the tests meet, one of each template in tests/messages.json.

A test asserts the class of an error or a warning and one keyword of its sentence. While it runs,
`pytest.raises`, `pytest.warns` and `commands.run` note the whole sentence by `hear`; at its end the
template of each sentence must be one of the snapshot. The template is the sentence without its
figures and quoted names, so the figures are for the tests themselves to assert.
`pytest --write-messages` adds new sentences, of tests that passed. If all tests ran, it also
removes the sentences that no test met.
"""

import contextlib
import json
import re
import sys
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
    # The name of the robot, and the place at which the line is folded.
    (r"A and B of \w+: verified, .*", "A and B of ROBOT: verified, RESIDUAL"),
    (r"\(choose from [^)]*\)", "(choose from CHOICES)"),
    # Texts of NumPy, and lists of SciPy's distributions, which depend on their versions.
    (r"\((This file contains|Cannot load file containing) pickled.*", "(PICKLED)"),
    (r"(no distribution of scipy\.stats named '\w+'; ).*", r"\1NAMES"),
    (r"(maximum recursion depth exceeded)[a-zA-Z ]*", r"\1"),
]
LONGEST = 400
NUMBER = re.compile(r"-?\d+(?:,\d{3})*(?:\.\d+)?(?:e[+-]?\d+)?")
QUOTED = re.compile(r"(?<!\w)'[^']*'(?!\w)")


def template(sentence):
    """Return a sentence without its figures and its quoted names."""
    return QUOTED.sub("'...'", NUMBER.sub("#", sentence))


def hear(text, kind=""):
    """Note a sentence of the test that runs, once for each template; return the text itself."""
    noted = text.strip()
    for pattern, word in VARIES:
        noted = re.sub(pattern, word, noted)
    noted = f"{kind}: {noted}"[:LONGEST] if kind else noted[:LONGEST]
    if template(noted) not in map(template, HEARD):
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
    for item in caught:
        if issubclass(item.category, fflin.FflinWarning):
            hear(str(item.message), item.category.__name__)


class Snapshot:
    """The sentences of tests/messages.json, by their templates."""

    def __init__(self, path):
        self.path = path
        sentences = json.loads(path.read_text("utf-8")) if path.exists() else []
        self.sentences = {template(sentence): sentence for sentence in sentences}

    def missing(self, heard):
        """Return the sentences whose template is not in the snapshot."""
        return [
            sentence for sentence in heard if template(sentence) not in self.sentences
        ]

    def write(self, heard, whole):
        """Add sentences; if all tests were run (`whole`), also remove those that were not heard."""
        new = {template(sentence): sentence for sentence in heard}
        kept = {
            key: message
            for key, message in self.sentences.items()
            if key in new or not whole
        }
        text = json.dumps(sorted((new | kept).values()), indent=1, ensure_ascii=False)
        self.path.write_text(text + "\n", encoding="utf-8")


# From this version on, Python words some of its own messages, which errors quote, in another way.
WORDED = (3, 14)


class Messages:
    """The plugin of a pytest session: hears each test, and compares or writes."""

    def __init__(self, config):
        self.config = config
        self.snapshot = Snapshot(config.rootpath / "tests" / "messages.json")
        self.write = config.getoption("write_messages")
        self.heard = {}
        self.narrowed = False

    @pytest.hookimpl(wrapper=True)
    def pytest_pyfunc_call(self, pyfuncitem):
        HEARD.clear()
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(pytest, "raises", raises)
            patch.setattr(pytest, "warns", warns)
            result = yield
        self.heard[pyfuncitem.nodeid] = HEARD.copy()
        missing = self.snapshot.missing(HEARD)
        if missing and not self.write and sys.version_info < WORDED:
            head = f"not in {self.snapshot.path.name}, to which `{COMMAND}` writes:"
            pytest.fail("\n  ".join([head, *missing]), pytrace=False)
        return result

    def pytest_deselected(self, items):
        self.narrowed = self.narrowed or bool(items)

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node):
        self.heard |= getattr(node, "workeroutput", {}).get("heard", {})
        self.narrowed = self.narrowed or getattr(node, "workeroutput", {}).get(
            "narrowed", True
        )

    def pytest_sessionfinish(self, exitstatus):
        if hasattr(self.config, "workeroutput"):
            self.config.workeroutput |= {"heard": self.heard, "narrowed": self.narrowed}
        elif self.write:
            default = self.config.getini("testpaths") or [
                str(self.config.invocation_params.dir)
            ]
            whole = (
                exitstatus == 0 and not self.narrowed and self.config.args == default
            )
            self.snapshot.write(
                [item for heard in self.heard.values() for item in heard], whole
            )
            errors_page.write(self.heard)


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
