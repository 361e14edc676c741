"""Every build of the site has what the executed pages wrote, whether it runs them or not."""

import re
import sys
from pathlib import Path

import pytest

from tests.support.patience import finished

for package in ("sphinx", "myst_nb"):
    pytest.importorskip(package, reason="the extra docs is not installed")

pytestmark = [pytest.mark.docs, pytest.mark.process]

CONF = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[1] / "docs/_ext")!r})
extensions = ["myst_nb", "executed"]
exclude_patterns = ["_*"]
nb_execution_mode = "force"
nb_execution_in_temp = True
nb_execution_raise_on_error = True
"""

PAGE = """---
file_format: mystnb
kernelspec:
  name: python3
---
# Title

```{{code-cell}}
import os
from fflin.view.html_page import HtmlPage
with open("{name}", "w") as file:
    file.write(f'<p>"{{os.getpid()}}" & more</p>')
HtmlPage("{name}")
```
"""


def build(source, site):
    finished([sys.executable, "-m", "sphinx", "-q", "-W", source, site], check=True)


def written(site):
    """Return {address: text} of what pages wrote, having seen that each is shown by its page."""
    result = {
        str(path.relative_to(site)): path.read_text()
        for path in site.glob("pages/**/*.html")
    }
    shown = "".join(
        path.read_text() for path in [site / "plain.html", *site.glob("inner/*.html")]
    )
    assert "srcdoc" not in shown
    assert all(
        f'src="{address}"' in shown or f'src="../{address}"' in shown
        for address in result
    )
    return result


def test_a_second_build_is_as_whole_as_the_first(tmp_path):
    source, one, two = (tmp_path / name for name in ("docs", "one", "two"))
    (source / "inner").mkdir(parents=True)
    (source / "conf.py").write_text(CONF)
    (source / "index.md").write_text("# All\n\n```{toctree}\nplain\ninner/page\n```\n")
    (source / "plain.md").write_text(PAGE.format(name="a.html"))
    (source / "inner/page.md").write_text(PAGE.format(name="a.html"))
    build(source, one)
    first = written(one)
    assert all(re.fullmatch(r'<p>"\d+" & more</p>', text) for text in first.values())
    assert {*first} == {"pages/plain/a.html", "pages/inner/page/a.html"}
    build(source, two)
    assert written(two) == first  # neither page is run again
    (source / "inner/page.md").write_text(PAGE.format(name="b.html"))
    build(source, one)
    edited = written(one)
    assert {*edited} == {"pages/plain/a.html", "pages/inner/page/b.html"}
    assert edited["pages/plain/a.html"] == first["pages/plain/a.html"]
    (source / "index.md").write_text("# All\n\n```{toctree}\nplain\n```\n")
    (source / "inner/page.md").unlink()
    build(source, two)
    assert {*written(two)} == {"pages/plain/a.html"}
