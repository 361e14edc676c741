"""From nothing to the first linear model."""

from benchmarks.processes import FIRST, IMPORT, ROBOT, programs, run_process, urdf_file
from benchmarks.tables import Table, figure
from benchmarks.timing import Times

REPETITIONS = 7


def run() -> Table:
    names, notes = programs()
    kinds = [(name, until) for name in names for until in (IMPORT, FIRST)]
    seconds: dict[tuple[str, str], list[float]] = {kind: [] for kind in kinds}
    with urdf_file() as path:
        for repetition in range(REPETITIONS + 1):
            for kind in kinds:
                time = run_process(*kind, path)[0]
                if repetition:  # the first reads the files from the disk
                    seconds[kind].append(time)
    times = {kind: Times(tuple(values)) for kind, values in seconds.items()}
    own = times["fflin", FIRST]
    rows = tuple(
        (
            name,
            figure(times[name, IMPORT].least * 1e3),
            figure(times[name, FIRST].least * 1e3),
            figure(times[name, FIRST].ratio(own)),
        )
        for name in names
    )
    return Table(
        "Start-up",
        "Whole processes, in turns. The columns are the time of Python and the import alone, and "
        f"the time until the first linear model of {ROBOT} from its URDF (Pinocchio: the first "
        "M^-1).",
        ("package", "import [ms]", "first model [ms]", "first model / fflin's"),
        rows,
        tuple(notes),
    )
