"""Redraw the pictures of pages: ``python docs/scripts/pictures.py capture uncertain_models``.

Run the Python of each page of docs/guide in a temporary folder and keep the figures that it saves.
A page that shows NAME_scene.png also gets a strip of pictures of its `motion` under this name.
"""

import os
import re
import shutil
import sys
import tempfile
from pathlib import Path

import fflin

DOCS = Path(__file__).resolve().parents[1]

for page in sys.argv[1:]:
    text = (DOCS / "guide" / f"{page}.md").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        names: dict = {}
        exec("\n".join(re.findall(r"```python\n(.*?)```", text, re.DOTALL)), names)
        for scene in re.findall(r"\]\(\.\./(\w+_scene\.png)\)", text):
            motion, start = names["motion"], names["motion"].starts[-1]
            times = [0.0, start, start + 5.0, motion.t[-1]]
            fflin.visualize(names["robot"], motion, png=scene, times=times, open=False)
        for picture in Path().glob("*.png"):
            if f"](../{picture})" in text:
                shutil.copy(picture, DOCS)
        os.chdir(DOCS)
