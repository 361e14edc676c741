"""Memory of a process, and of the results."""

from benchmarks.processes import FIRST, IMPORT, ROBOT, programs, run_process, urdf_file
from benchmarks.tables import Table, figure


def run() -> Table:
    names, notes = programs()
    with urdf_file() as path:
        peaks = {
            name: [run_process(name, until, path)[1] for until in (IMPORT, FIRST)]
            for name in names
        }
    own = peaks["fflin"][1]
    rows = tuple(
        (name, figure(imported), figure(first), figure(first / own))
        for name, (imported, first) in peaks.items()
    )
    return Table(
        "Memory",
        "Peak resident memory of a process after the import, and after the first linear model of "
        f"{ROBOT}.",
        ("package", "import [MiB]", "first model [MiB]", "first model / fflin's"),
        rows,
        tuple(notes),
    )
