"""The pages of the site as they are written: links lead somewhere, messages are those of the code, tests that are named exist."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import kfgs

ROOT = Path(kfgs.__file__).parents[1]
DOCS = ROOT / "docs"
if not (DOCS / "conf.py").is_file() or not (ROOT / "benchmarks").is_dir():  # an installed kfgs, a source distribution
    pytest.skip(f"not the whole repository in {ROOT}", allow_module_level=True)
WRITTEN = [path for path in sorted(DOCS.rglob("*.md")) if "_build" not in path.parts]
PAGES = [path for path in WRITTEN if path.name != "leaderboard.md"]  # which a program writes
OTHERS = [
    ROOT / name for name in ("README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md", "notebooks/README.md")
]
LINKED = WRITTEN + [path for path in OTHERS if path.is_file()]
LARGEST = 100_000  # bytes of a picture of the site


def name_of(path):
    return str(path.relative_to(ROOT))


def without_code(text):
    return re.sub(r"`[^`\n]*`", "", re.sub(r"^(`{3,}).*?^\1", "", text, flags=re.DOTALL | re.MULTILINE))


@cache
def anchors_of(path):
    """The anchors of a page as GitHub and MyST make them: headings in small letters, and those that are named."""
    text = path.read_text(encoding="utf-8")
    titles = re.findall(r"^#+ (.+)$", re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE)
    made = {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}
    return made | set(re.findall(r"^\(([\w-]+)\)=$", text, re.MULTILINE))


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_links_within_the_repository_lead_to_a_file_and_a_heading(page):
    text = without_code(page.read_text(encoding="utf-8"))
    for target in re.findall(r"\]\(([^)\s]+)\)", text):
        if re.match(r"[a-z]+:", target):
            continue
        place, _, anchor = target.partition("#")
        file = (page.parent / place).resolve() if place else page
        assert file.exists(), f"{name_of(page)}: no {target}"
        if anchor:
            assert anchor in anchors_of(file), f"{name_of(page)}: no heading {target}"


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_a_page_begins_with_the_question_that_it_answers(page):
    first = re.sub(r"\A# .+\n+", "", page.read_text(encoding="utf-8"))
    paragraph = first.split("\n\n")[0].replace("\n", " ")
    assert re.match(r"\*\*[^*]+", paragraph), paragraph[:80]
    assert "?" in paragraph, paragraph[:80]


@pytest.mark.parametrize(("page", "least", "without"), [("promises.md", 11, 0), ("paper.md", 50, 4)])
def test_a_table_of_tests_names_those_that_exist(page, least, without):
    """Every row ends in tests or, as often as it is known, says that there is none and why."""
    text = (DOCS / page).read_text(encoding="utf-8")
    rows = [row for row in re.findall(r"^\| .+ \| (.+) \|$", text, re.MULTILINE) if row != "test"]
    assert len(rows) >= least
    assert sum(row.startswith("no test: ") for row in rows) == without == sum("::" not in row for row in rows)
    for file, test in re.findall(r"`(tests/[^`]+)::(\w+)`", text):
        tree = ast.parse((ROOT / file).read_text(encoding="utf-8"))
        assert test in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}, f"{file} has no {test}"


@cache
def texts_of_the_code():
    """All texts in the code of kfgs; of an f-string, what stands between its values."""
    found = []
    for path in (ROOT / "kfgs").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.append(node.value)
    return "\0".join(found)


MESSAGES = re.findall(r"^### `(.+)`$", (DOCS / "faq.md").read_text(encoding="utf-8"), re.MULTILINE)


@pytest.mark.parametrize("message", MESSAGES)
def test_a_message_that_the_site_explains_is_one_of_the_code(message):
    for part in message.split("..."):
        assert part.strip() in texts_of_the_code(), part


@pytest.mark.parametrize("picture", sorted((DOCS / "pictures").glob("site_*")), ids=name_of)
def test_a_picture_of_the_site_is_small_and_shown(picture):
    assert picture.stat().st_size < LARGEST
    assert any(picture.name in page.read_text(encoding="utf-8") for page in PAGES)
