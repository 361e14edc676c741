"""Paragraphs of reports: a line, and the indented lines that continue it."""

import re

PARAGRAPH = re.compile(r"\n(?!  \S)")


def first_paragraph(report: str) -> str:
    """Return the first line of a report, together with the indented lines that continue it."""
    return " ".join(PARAGRAPH.split(report, maxsplit=1)[0].split())


def without_first_paragraph(report: str, paragraph: str) -> str:
    """Return a report without its first paragraph, if this is `paragraph` with any line breaks."""
    if first_paragraph(report) != " ".join(paragraph.split()):
        return report
    return "".join(PARAGRAPH.split(report, maxsplit=1)[1:])
