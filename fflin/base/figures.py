"""What every figure has: its style, its colours, and the file it is saved to."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fflin.base.errors import MissingPackageError
from fflin.base.writing import as_path, check_ending, write_whole

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FORMATS = (".png", ".pdf", ".svg")

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000", "#8a6d3b")
_STYLE: dict[Any, Any] = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.framealpha": 0.8,
    "legend.edgecolor": "none",
    "legend.fontsize": 8,
    "figure.dpi": 150,
    "savefig.dpi": 150,
}


def cycle(count: int) -> list[str]:
    """Return that many colours, all different."""
    if count <= len(COLORS):
        return list(COLORS[:count])
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["turbo"](i / (count - 1))) for i in range(count)]


class styled:
    """The style, for as long as a figure is drawn, and the class of figures without a window."""

    def __enter__(self) -> Any:
        require_matplotlib()
        import matplotlib
        from matplotlib.figure import Figure

        self._context = matplotlib.rc_context(_STYLE)
        self._context.__enter__()
        return Figure

    def __exit__(self, *problem: object) -> None:
        self._context.__exit__(None, None, None)


def require_matplotlib() -> None:
    """Raise `MissingPackageError` where matplotlib is not installed or cannot be loaded."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        raise MissingPackageError(
            "figures need matplotlib; install it with: pip install 'fflin[plot]'"
        ) from None
    except ValueError as error:  # of the environment's MPLBACKEND, or of a settings file
        said = str(error).partition(";")[0]
        raise MissingPackageError(f"matplotlib cannot be loaded: {said}; mend MPLBACKEND") from None


def target_of(path: str | Path | None) -> Path | None:
    """Return the path of a figure, checked, or None."""
    if path is None:
        return None
    target = as_path(path)
    check_ending(target, FORMATS)
    return target


def saved(figure: Figure, target: Path | None) -> Figure:
    """Return the figure, written where there is a target."""
    if target is not None:
        content = io.BytesIO()
        figure.savefig(content, format=target.suffix[1:])
        write_whole({target: content.getvalue()})
    return figure
