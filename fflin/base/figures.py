"""Style, colours and output files of figures."""

import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from fflin.base.errors import InputError, MissingPackageError, optional_package
from fflin.base.validation import Array
from fflin.base.writing import as_path, check_ending, write_atomically

if TYPE_CHECKING:
    from matplotlib.artist import Artist as Artist
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    # Matplotlib is imported only when a figure is drawn.
    Artist = Axes = Figure = object

FORMATS = (".png", ".pdf", ".svg")

# Colours of curves in figures and on pages. They differ in CIEDE2000 by at least 15, also for
# people with protanopia or deuteranopia, and can be read on white and on a dark ground.
COLORS = (
    "#d40007",
    "#34c7b1",
    "#2e63fc",
    "#c11684",
    "#70b8fd",
    "#f5931a",
    "#fb447e",
    "#317b58",
)
# The colours after the first _SOLID are drawn with dashes and dots.
_SOLID = 5
# Units of revolute joints, prismatic joints and modes, in the order of the charts of a motion.
_UNITS_OF_JOINTS = ("rad", "m", "kg^0.5 m")
# Colour of curves that have none of COLORS, because others change more.
GREY = "#8a93a5"
_STYLE = Path(__file__).parent / "assets" / "figures.mplstyle"


class CurveStyle(NamedTuple):
    """Colour and line style of a curve in figures and on pages."""

    color: str
    dashed: bool = False

    @property
    def line(self) -> str:
        """Line style of matplotlib."""
        return "-." if self.dashed else "-"

    @property
    def is_named(self) -> bool:
        """Whether the curve is coloured; only coloured curves are in the legend."""
        return self.color != GREY


def curve_styles(changes: Mapping[str, float]) -> dict[str, CurveStyle]:
    """Return the style of each curve, given how much it changes.

    If there are more curves than COLORS, those that change most are coloured, and the others are
    grey. The order of the colours is the order of the curves.
    """
    names = list(changes)
    largest = sorted(names, key=lambda name: -changes[name])[: len(COLORS)]
    named = [name for name in names if name in largest]
    styles = dict.fromkeys(names, CurveStyle(GREY))
    for index, name in enumerate(named):
        styles[name] = CurveStyle(COLORS[index], dashed=index >= _SOLID)
    return styles


def joint_styles(units: Mapping[str, str]) -> dict[str, CurveStyle]:
    """Return the styles of joints, given {joint: unit} without wheels.

    In the figures and on the page of every motion, the joints have these styles. The result is
    empty if there are more joints than COLORS, because then their styles depend on the motion.
    """
    if len(units) > len(COLORS):
        return {}
    names = sorted(units, key=lambda name: _UNITS_OF_JOINTS.index(units[name]))
    return curve_styles(dict.fromkeys(names, 0.0))


def cycle(count: int) -> list[str]:
    """Return `count` different colours."""
    if count <= len(COLORS):
        return list(COLORS[:count])
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    return [to_hex(colormaps["turbo"](i / (count - 1))) for i in range(count)]


def letters_of(count: float, height: float) -> float:
    """Return the font size [pt], at most 8, at which `count` lines fit into a height [pt]."""
    return min(8.0, 0.75 * height / max(1, count))


def logarithmic(
    axes: Axes, axis: Literal["x", "y"], values: Array, unit: float
) -> None:
    """Set a symmetric logarithmic scale on an axis if the magnitudes of `values` span a decade.

    Magnitudes up to 1e-9 times `unit` are ignored.
    """
    sizes = [abs(value) for value in values.tolist() if abs(value) > 1e-9 * unit]
    if not sizes or max(sizes) < 10.0 * min(sizes):
        return
    least = 10.0 ** math.floor(math.log10(min(sizes)))
    getattr(axes, f"set_{axis}scale")("symlog", linthresh=least, linscale=0.5)
    getattr(axes, f"{axis}axis").get_major_locator().set_params(numticks=9)
    low, high = (2.0 * float(end) for end in (values.min(), values.max()))
    getattr(axes, f"set_{axis}lim")(min(low, -0.5 * least), max(high, 0.5 * least))


def figure_file(path: str | Path | None) -> Path | None:
    """Return the path of a figure; raise `FileError` if its ending is not one of FORMATS."""
    if path is None:
        return None
    target = as_path(path)
    check_ending(target, FORMATS)
    return target


@contextmanager
def drawing(
    path: str | Path | None, width: float, height: float, axes: object = None
) -> Iterator[Figure]:
    """Yield a figure of `width` x `height` [in] in fflin's style; save it if a path is given.

    If `axes` are given, the figure is a subfigure that takes the place of these axes in a grid.
    """
    target = figure_file(path)
    require_matplotlib()
    import matplotlib

    from fflin.base.shown_figure import ShownFigure

    style = matplotlib.rc_params_from_file(_STYLE, use_default_template=False)
    with matplotlib.rc_context(style):
        if axes is None:
            figure: Figure = ShownFigure((width, height), layout="constrained")
        else:
            figure = _in_place_of(axes)
        yield figure
        if target is not None:
            content = io.BytesIO()
            figure.savefig(content, format=target.suffix[1:])
            write_atomically({target: content.getvalue()})


def _in_place_of(axes: object) -> Figure:
    """Return a subfigure in place of axes, which are removed.

    Raise `InputError` if `axes` are not axes in a grid, such as ``pyplot.subplots`` returns.
    """
    from matplotlib.axes import Axes as GivenAxes

    spec = None
    if isinstance(axes, GivenAxes):
        spec = axes.get_subplotspec()
    if not isinstance(axes, GivenAxes) or spec is None:
        kind = type(axes).__name__
        raise InputError(
            f"axes has type {kind}, expected matplotlib axes, as of pyplot.subplots"
        )
    owner: Any = axes.figure
    root: Any = axes.get_figure(root=True)
    if root.get_layout_engine() is None:
        root.set_layout_engine("constrained")  # legends beside the panels need it
    axes.remove()
    figure: Figure = owner.add_subfigure(spec)
    return figure


def require_matplotlib() -> None:
    """Raise `MissingPackageError` if matplotlib is not installed or cannot be loaded."""
    try:
        optional_package("matplotlib", "figures need matplotlib", "plot")
    except ValueError as error:  # invalid MPLBACKEND or settings file
        why = str(error).partition(";")[0]
        message = f"matplotlib cannot be loaded: {why}; correct MPLBACKEND"
        raise MissingPackageError(message) from None


def legend_below(panel: Axes, names: Sequence[str], title: str) -> None:
    """Draw a legend below the figure, with a name for each of the first curves of a panel."""
    panel.figure.legend(
        panel.get_lines()[: len(names)],
        names,
        title=title,
        loc="outside lower center",
        ncols=2,
        fontsize=letters_of(1.3 * len(names), 200.0),
    )
