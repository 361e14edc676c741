"""Figure that notebooks show as a picture. This module needs matplotlib."""

import io

from matplotlib.figure import Figure

# Pixels per inch of a figure: of the width in a notebook, and of the picture, which is finer so
# that it is also sharp on screens with small pixels.
_PER_INCH, _RESOLUTION = 80.0, 120.0


class ShownFigure(Figure):
    """Figure that is drawn only when a notebook shows it, whatever backend is set.

    The figure is unknown to pyplot, so pyplot neither shows it a second time nor keeps it.
    """

    def _repr_png_(self) -> tuple[bytes, dict[str, int]]:
        """Return the picture, and the width [px] at which a notebook shows it."""
        content = io.BytesIO()
        self.savefig(content, format="png", dpi=_RESOLUTION)
        return content.getvalue(), {"width": round(_PER_INCH * self.get_figwidth())}
