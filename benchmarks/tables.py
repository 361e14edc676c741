"""Tables in Markdown, the machine and versions they stand for, and their place in the README."""

import importlib.metadata
import platform
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
RESULTS, README = (ROOT / "benchmarks" / name for name in ("results.md", "README.md"))
BEGIN, END = "<!-- benchmarks: begin -->", "<!-- benchmarks: end -->"
PACKAGES = (
    "pin",
    "numpy",
    "scipy",
    "numba",
    "mujoco",
    "drake",
    "bsk",
    "crocoddyl",
    "adam-robotics",
    "casadi",
    "control",
)
MISSING = "–"


@dataclass(frozen=True)
class Table:
    """One case: rows of cells, the first naming the row, and notes on what is not there."""

    title: str
    about: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()
    in_readme: bool = False

    def markdown(self, level: int = 2) -> str:
        lines = [f"{'#' * level} {self.title}", "", self.about, ""]
        lines += self.grid()
        lines += ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join(lines) + "\n"

    def grid(self) -> list[str]:
        rows = [self.header, *self.rows]
        widths = [max(len(row[i]) for row in rows) for i in range(len(self.header))]
        aligned = ["| " + " | ".join(_cells(row, widths)) + " |" for row in rows]
        rule = ["-" * widths[0], *("-" * (width - 1) + ":" for width in widths[1:])]
        return [aligned[0], "| " + " | ".join(rule) + " |", *aligned[1:]]


def _cells(row: Sequence[str], widths: Sequence[int]) -> list[str]:
    return [
        row[0].ljust(widths[0]),
        *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True)),
    ]


def figure(value: float | None) -> str:
    """Write a time or a ratio with two or three digits."""
    if value is None:
        return MISSING
    if value >= 99.5:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 9.95 else f"{value:.2f}"


def machine() -> str:
    """Return the processor, the system and the versions of what is compared."""
    cpu = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            cpu = next(
                line.split(":")[1].strip() for line in file if "model name" in line
            )
    except (OSError, StopIteration):
        pass
    from fflin.base import __version__

    versions = [f"Python {platform.python_version()}", f"fflin {__version__}"]
    for name in PACKAGES:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            versions.append(f"{name} not installed")
    return f"{cpu}, {platform.system()}, one thread; {', '.join(versions)}."


def document(tables: Sequence[Table], command: str) -> str:
    """Return the whole file of results."""
    head = (
        f"# Benchmarks\n\nMade by `{command}`. {machine()} Each time is the shortest of many "
        "rounds in which the candidates take turns.\n\n"
    )
    return head + "\n".join(table.markdown() for table in tables)


def insert_in_readme(tables: Sequence[Table], command: str) -> None:
    """Put the tables that the README shows between its markers."""
    text = README.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, found, after = rest.partition(END)
    if not found:
        raise SystemExit(f"benchmarks/README.md has no '{BEGIN}' followed by '{END}'")
    shown = [table for table in tables if table.in_readme]
    body = "\n".join(
        textwrap.fill(f"{table.title}. {table.about}", 100)
        + "\n\n"
        + "\n".join(table.grid())
        + "\n"
        for table in shown
    )
    made = textwrap.fill(f"`{command}` made these on: {machine()}", 100)
    README.write_text(
        f"{before}{BEGIN}\n{body}\n{made}\n{END}{after}",
        encoding="utf-8",
    )
