"""For the pages that are run: figures and warnings as a reader sees them, and pages that play."""

import os
import re
import shutil
import warnings
from pathlib import Path

from IPython import get_ipython
from IPython.display import HTML

get_ipython().run_line_magic("matplotlib", "inline")
get_ipython().run_line_magic("config", "InlineBackend.figure_formats = ['svg']")
# As the command line shows them, without the place in a notebook that nobody sees.
warnings.showwarning = lambda message, category, *_: print(f"{category.__name__}: {message}")


def embed(page: str, height: int = 480) -> HTML:
    """Show a page that `fflin.visualize` wrote, and keep it for the site."""
    shown_by, kept = os.environ["FFLIN_DOCS_PAGE"], Path(os.environ["FFLIN_DOCS_KEPT"])
    folder = kept / shown_by
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(page, folder / Path(page).name)
    address = f"{'../' * shown_by.count('/')}pages/{shown_by}/{Path(page).name}"
    return HTML(
        f'<iframe class="fflin-page" src="{address}" height="{height}" loading="lazy" '
        f'title="{page}"></iframe>'
        f'<p class="fflin-page-link"><a href="{address}">{page} by itself</a></p>'
    )


# At the address #hero, a page shows the scene alone, and plays it again and again. Where readers
# prefer reduced motion, the scene stays at a time at which the robot turns.
_HERO = """<script>
if (location.hash === "#hero") {
  const begin = () => {
    if (!window.fflin || !window.fflin.ready) return;
    clearInterval(wait);
    fflin.plain(true, false);
    parent.postMessage("fflin-hero", "*");
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      fflin.pause();
      fflin.seek(8);
      return;
    }
    fflin.play();
    setInterval(() => { if (!fflin.state.playing) fflin.play(); }, 1500);
  };
  const wait = setInterval(begin, 50);
}
</script>
</body>"""


def hero() -> HTML:
    """Run the Python of the front page, and show its motion without panel and controls.

    Until the scene is drawn, a picture stands in its place. A click opens the page itself.
    """
    source = Path(__file__).parents[1] / "index.md"
    code = re.findall(r"```python\n(.*?)```", source.read_text("utf-8"), re.DOTALL)[0]
    exec(code, {})
    page = Path("motion.html")
    page.write_text(page.read_text("utf-8").replace("</body>", _HERO), "utf-8")
    embed("motion.html")
    address = f"pages/{os.environ['FFLIN_DOCS_PAGE']}/motion.html"
    return HTML(
        f'<a class="fflin-hero" href="{address}" title="open the page of this motion">'
        '<img src="_static/hero_still.webp" alt="A satellite with an arm returns from 30 degrees">'
        f'<iframe src="{address}#hero" title="the motion of the example" tabindex="-1">'
        "</iframe></a>"
    )
