"""Draw the pictures of pages again: ``python docs/pictures.py catch.md uncertainty.md``.

It runs the Python of each page in a folder of its own and keeps the figures that this saves; a page
that shows a motion has a strip of pictures of it too, PAGE_scene.png.
"""

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import fflin

DOCS = Path(__file__).resolve().parent

for page in sys.argv[1:]:
    text = (DOCS / page).read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        names: dict = {}
        exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), names)
        scene = f"{Path(page).stem}_scene.png"
        if f"]({scene})" in text:
            motion, start = names["motion"], names["motion"].starts[-1]
            times = [0.0, start, start + 5.0, motion.t[-1]]
            fflin.visualize(names["robot"], motion, png=scene, times=times, open=False)
        for picture in Path().glob("*.png"):
            if f"]({picture})" in text:
                shutil.copy(picture, DOCS)
        os.chdir(DOCS)
