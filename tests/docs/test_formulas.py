"""The formulas of the site in a real browser that reaches no other machine: MathJax draws each of them."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from cases_web import SECONDS, needs_chromium, software_chromium

import kfgs

DOCS = Path(kfgs.__file__).parents[1] / "docs"
if not (DOCS / "conf.py").is_file():
    pytest.skip(f"no site in {DOCS}", allow_module_level=True)
for package in ("sphinx", "furo", "myst_nb"):
    pytest.importorskip(package, reason='the site needs: pip install "kfgs[docs]"')
pytestmark = needs_chromium

PAGES = [path for path in sorted(DOCS.glob("*.md")) if "$$" in path.read_text(encoding="utf-8")]
OFFLINE = "--host-resolver-rules=MAP * ~NOTFOUND"
LOOK = """async () => {
  await globalThis.MathJax?.startup?.promise;
  const drawn = [...document.querySelectorAll(".math mjx-container svg")];
  return {
    formulas: document.querySelectorAll(".math").length,
    drawn: drawn.filter((svg) => svg.getBoundingClientRect().width > 0).length,
    wrong: document.querySelectorAll(".math [data-mml-node=merror], .math mjx-container [fill=red]").length,
  };
}"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The pages with formulas alone, by the site's own configuration: seconds instead of the whole site's half minute."""
    source, built = tmp_path_factory.mktemp("pages"), tmp_path_factory.mktemp("site")
    for page in PAGES:
        (source / page.name).write_bytes(page.read_bytes())
    (source / "index.md").write_text("# Pages\n")
    command = [sys.executable, "-m", "sphinx", "-Q", "-b", "html", "-c", DOCS, source, built]
    subprocess.run(command, check=True, timeout=SECONDS)
    return built


def test_every_formula_is_drawn_without_a_network(site):
    with software_chromium(OFFLINE) as browser:
        tab = browser.new_page()
        tab.set_default_timeout(1000 * SECONDS)
        for page in PAGES:
            tab.goto((site / f"{page.stem}.html").as_uri())
            found = tab.evaluate(LOOK)
            assert found["formulas"] >= len(re.findall(r"^\$\$", page.read_text(encoding="utf-8"), re.MULTILINE)) > 0
            assert found["drawn"] == found["formulas"], page
            assert found["wrong"] == 0, page  # an error of TeX, or a command that MathJax does not know (drawn in red)
