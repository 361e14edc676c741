"""What a figure looks like, by the extents of what its renderer draws."""

from matplotlib.axis import Axis
from matplotlib.text import Text


def texts(figure):
    """Return [(text, extent)] of all that is written, as it is drawn."""
    figure.draw_without_rendering()
    outside = set()
    for axis in figure.findobj(Axis):
        # An axis keeps the labels of ticks that it does not show.
        low, high = sorted(axis.get_view_interval())
        for tick in (*axis.majorTicks, *axis.minorTicks):
            if not low <= tick.get_loc() <= high:
                outside |= {id(tick.label1), id(tick.label2)}
    return [
        (text.get_text(), text.get_window_extent())
        for text in figure.findobj(Text)
        if text.get_visible() and text.get_text().strip() and id(text) not in outside
    ]


def assert_legible(figure):
    """Nothing written lies on anything else that is written, or beyond the edge of the figure."""
    boxes = texts(figure)
    for i, (text, box) in enumerate(boxes):
        for other, at in boxes[:i]:
            over = (
                min(box.x1, at.x1) - max(box.x0, at.x0),
                min(box.y1, at.y1) - max(box.y0, at.y0),
            )
            # Half a pixel is what the extent of a letter is rounded by.
            assert min(over) <= 0.5, f"{text!r} lies on {other!r}"
        assert box.x0 >= -1.0 and box.x1 <= figure.bbox.x1 + 1.0, f"{text!r} is cut"
        assert box.y0 >= -1.0 and box.y1 <= figure.bbox.y1 + 1.0, f"{text!r} is cut"
