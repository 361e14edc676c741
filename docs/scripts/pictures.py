"""Redraw the pictures of pages: ``python docs/scripts/pictures.py capture uncertain_models``.

Run the Python and the commands of each page of docs/guide in a temporary folder, with the TOML
files that the page shows, and keep the figures that it saves.
A page that shows NAME_scene.webp also gets a strip of pictures of its `motion` under this name.
"""

import os
import re
import shlex
import sys
import tempfile
from pathlib import Path

from PIL import Image

import fflin
from fflin.commands.cli import main

BLOCK = re.compile(r"^```(python|sh|toml)\n(.*?)^```", re.DOTALL | re.MULTILINE)
DOCS = Path(__file__).resolve().parents[1]

for page in sys.argv[1:]:
    text = (DOCS / "guide" / f"{page}.md").read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        names: dict = {}
        for block in BLOCK.finditer(text):
            language, body = block.groups()
            if language == "toml":
                name = re.findall(r"`(\w+\.toml)`", text[: block.start()])[-1]
                Path(name).write_text(body, encoding="utf-8")
            elif language == "python":
                exec(body, names)
            else:
                commands = [shlex.split(line, comments=True) for line in body.splitlines()]
                for words in commands:
                    if words[:1] == ["fflin"]:
                        main(words[1:])
        for scene in re.findall(r"\]\(\.\./(\w+_scene)\.webp\)", text):
            motion, start = names["motion"], names["motion"].starts[-1]
            times = [0.0, start, start + 5.0, motion.t[-1]]
            fflin.visualize(names["robot"], motion, png=f"{scene}.png", times=times, open=False)
        for picture in Path().glob("*.png"):
            target = picture.with_suffix(".webp")
            if f"](../{target})" in text:
                # Pictures of scenes lose a little detail, figures none.
                scene = picture.stem.endswith("_scene")
                Image.open(picture).save(DOCS / target, lossless=not scene, quality=90, method=6)
        os.chdir(DOCS)
