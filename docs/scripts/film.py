"""Draw moving pictures: ``python docs/scripts/film.py hero``, ``... tutorials``, ``... examples``.

``hero`` simulates the example of the README, and draws docs/hero.webp and a still picture.
``tutorials`` draws docs/_static/tutorials/NAME.webp from the page that the tutorial wrote in the
last build of the site. If a tutorial writes no page, its code is run, and its motion is shown.
``examples`` runs the scripts of examples/ and draws docs/_static/examples/NAME.webp. Names after
the word select tutorials or examples.
Needs Chromium and playwright, which the extra ``test`` installs.
"""

import io
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import fflin
from fflin.view.capture import find_chromium

DOCS = Path(__file__).resolve().parents[1]
PAGES = DOCS / "_build" / "executed" / "pages" / "tutorials"
EXAMPLES = DOCS.parent / "examples"
FPS = 12
# Small pictures are [px] wide and high, and have this number of frames. They are drawn larger by
# this factor, which smooths their edges.
SMALL, SMALL_FRAMES, ENLARGED = (256, 160), 24, 2
# The last picture stays for this time [ms] before the film begins again.
REST = 1500
BROWSER = (
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
)


def frames(
    html: Path, size: tuple[int, int], count: int, share: float, *, texts: bool = True
) -> list[Image.Image]:
    """Return pictures of the scene at equal distances in the first `share` of the motion.

    With `texts`, each picture states its time.
    """
    width, height = size
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=find_chromium(), args=[*BROWSER])
        page = browser.new_page(viewport={"width": width, "height": height})
        page.goto(f"{html.resolve().as_uri()}#pause")
        page.wait_for_function("window.fflin && window.fflin.ready", timeout=120_000)
        if not texts:
            page.add_style_tag(content="#stamp, #legend { display: none !important }")
        page.evaluate("fflin.plain(true, false)")
        first, last = page.evaluate(
            "(() => { const s = document.querySelector('#bar input[type=range]');"
            " return [Number(s.min), Number(s.max)]; })()"
        )
        pictures = []
        for index in range(count):
            time = first + share * (last - first) * index / (count - 1)
            pictures.append(shot(page, time))
        browser.close()
    return pictures


def shot(page: Page, time: float) -> Image.Image:
    """Return a picture of the scene at a time [s]."""
    page.evaluate(
        f"fflin.seek({time}); new Promise(done => requestAnimationFrame(() =>"
        " requestAnimationFrame(() => done(1))))"
    )
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


def save(pictures: list[Image.Image], path: Path, quality: int) -> None:
    """Write an animated WebP, whose last picture stays for a while."""
    durations = [1000 // FPS] * (len(pictures) - 1) + [REST]
    first, *others = pictures
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=durations,
        loop=0,
        quality=quality,
        method=6,
    )
    print(f"{path.relative_to(DOCS)}: {len(pictures)} pictures, {path.stat().st_size / 1e6:.2f} MB")


def hero() -> None:
    """Draw the motion of the README, and its state after 8 s as a still picture."""
    robot = fflin.load("servicer_7dof")
    lin = fflin.linearize(robot)
    policy = fflin.StateFeedback(lin, fflin.lqr(lin).K)
    q0 = fflin.configuration(robot, rpy=(30, 0, 0))
    motion = fflin.simulate(robot, policy, q0=q0, duration=80.0)
    with tempfile.TemporaryDirectory() as folder:
        html = fflin.visualize(robot, motion, html=Path(folder, "hero.html"), speed=8.0)
        pictures = frames(Path(html), (830, 467), 72, 1.0)
    save(pictures, DOCS / "hero.webp", 70)
    pictures[7].save(DOCS / "_static" / "hero_still.webp", quality=82, method=6)


def tutorials(names: list[str]) -> None:
    """Draw a small film of each tutorial, or only of those named."""
    target = DOCS / "_static" / "tutorials"
    target.mkdir(exist_ok=True)
    for source in sorted((DOCS / "tutorials").glob("*.md")):
        if source.stem == "index" or (names and source.stem not in names):
            continue
        with tempfile.TemporaryDirectory() as folder:
            # A page of modes has no time.
            written = [
                file for file in (PAGES / source.stem).glob("*.html") if file.stem != "modes"
            ]
            html = written[0] if written else run(source, Path(folder))
            pictures = frames(html, (416, 260), 30, 1.0)
        save(pictures, target / f"{source.stem}.webp", 55)


def run(source: Path, folder: Path) -> Path:
    """Run the code of a tutorial, and return the page of its motion, or of its robot at rest."""
    code = re.findall(
        r"```\{code-cell\}\n(?::[^\n]*\n)*(.*?)```", source.read_text("utf-8"), re.DOTALL
    )
    names: dict[str, Any] = {}
    os.chdir(folder)
    exec("\n".join(cell for cell in code if "pages" not in cell), names)
    html = folder / "page.html"
    motion = names.get("motion", names.get("in_python"))
    fflin.visualize(names["robot"], motion, html=html)
    os.chdir(DOCS)
    return html


def examples(names: list[str]) -> None:
    """Draw a small film of each example, or only of those named."""
    target = DOCS / "_static" / "examples"
    target.mkdir(exist_ok=True)
    for source in sorted(EXAMPLES.glob("*.py")):
        if names and source.stem not in names:
            continue
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            code: dict[str, Any] = {}
            exec(source.read_text("utf-8"), code)
            if "campaign" in code:
                campaign = code["campaign"]
                motion = campaign.replay(campaign.worst(1)[0])
            else:
                motion = code.get("motion", code.get("in_c"))
            html = Path(folder, "page.html")
            fflin.visualize(code["robot"], motion, html=html, open=False)
            os.chdir(DOCS)
            width, height = SMALL
            drawn = frames(
                html, (ENLARGED * width, ENLARGED * height), SMALL_FRAMES, 1.0, texts=False
            )
            pictures = [picture.resize(SMALL, Image.Resampling.LANCZOS) for picture in drawn]
        save(pictures, target / f"{source.stem}.webp", 45)


if __name__ == "__main__":
    if sys.argv[1:] == ["hero"]:
        hero()
    elif sys.argv[1:2] == ["examples"]:
        examples(sys.argv[2:])
    else:
        tutorials(sys.argv[2:])
