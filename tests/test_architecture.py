"""The picture of the rooms is that of the code."""

import runpy
from pathlib import Path

DOCS = Path(__file__).parents[1] / "docs"


def test_the_picture_is_made_from_the_code_and_no_import_runs_up():
    rooms = runpy.run_path(str(DOCS / "rooms.py"))
    picture = rooms["drawing"]()
    assert (DOCS / "rooms.svg").read_text(encoding="utf-8") == picture, "run python docs/rooms.py"
    assert 'class="up"' not in picture
    assert len(rooms["rooms"]()) == 13
