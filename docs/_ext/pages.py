"""For the pages that are run: figures and warnings as a reader sees them, and pages that play."""

import os
import shutil
import warnings
from pathlib import Path

from IPython import get_ipython
from IPython.display import HTML

get_ipython().run_line_magic("matplotlib", "inline")
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
