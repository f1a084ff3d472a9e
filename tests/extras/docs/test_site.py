"""The site that ``make docs`` has built: links, names, tutorials and their notebooks."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path
from urllib.parse import unquote, urlsplit

import nbformat
import pytest
from bs4 import BeautifulSoup
from sphinx.util.inventory import InventoryFile

import marl_explore

DOCS = Path(__file__).parents[3] / "docs"
SITE = DOCS / "_build/html"
TUTORIALS = ("plan", "train", "happo")


@pytest.fixture(scope="module")
def pages():
    found = {path.resolve(): path.read_text() for path in SITE.rglob("*.html")}
    return {path: BeautifulSoup(text, "html.parser") for path, text in found.items()}


def test_every_link_leads_somewhere(pages):
    named = {
        path: {tag["id"] for tag in page.find_all(id=True)} | {""} for path, page in pages.items()
    }
    broken, others = [], set()
    for path, page in pages.items():
        for tag in page.find_all(["a", "img"]):
            link = tag.get("href") or tag.get("src") or ""
            parts = urlsplit(link)
            if parts.scheme:
                others.add(link)
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            found = target.is_file() and unquote(parts.fragment) in named.get(target, {""})
            broken += [] if found else [(path.name, link)]
    assert broken == []
    # other sites are asked by make docs-links; here only what cannot be an address is found
    assert all(re.match(r"(https?://[\w.-]+\.\w+(/|$|#)|data:image/)", link) for link in others)


def test_every_page_of_the_folder_is_in_the_contents(pages):
    contents = {a["href"] for a in pages[SITE / "index.html"].select(".sidebar-tree a[href]")}
    sources = {path.relative_to(DOCS) for path in DOCS.rglob("*.md") if SITE not in path.parents}
    wanted = {str(source.with_suffix(".html")) for source in sources}
    assert wanted - contents - {"index.html"} == set()


def test_every_public_name_is_documented():
    inventory = InventoryFile.loads((SITE / "objects.inv").read_bytes(), uri="")
    documented = {name for kind in inventory.data.values() for name in kind}
    missing = {name for name in marl_explore.__all__ if f"marl_explore.{name}" not in documented}
    modules = {"metrics", "plots", "stats", "records", "tables"}
    assert missing == modules
    assert {getattr(marl_explore, name).__name__ for name in modules} <= documented


def test_docstrings_leave_no_markup(pages):
    for path, page in pages.items():
        if path.parent.name == "reference":
            text = " ".join(dd.get_text() for dd in page.select("dl.py dd > p"))
            assert re.findall(r"``|\\\[|:\w+:`", text) == [], path.name


def notebook(name):
    (path,) = SITE.glob(f"_downloads/*/{name}.ipynb")
    return nbformat.read(path, as_version=4)


def printed(name):
    cells = [cell for cell in notebook(name).cells if cell.cell_type == "code"]
    return "".join(o.text for cell in cells for o in cell.outputs if o.get("name") == "stdout")


@pytest.mark.parametrize("name", TUTORIALS)
def test_notebook(name, pages):
    book = notebook(name)
    nbformat.validate(book)
    assert book.metadata.kernelspec.name == "python3"
    cells = [cell for cell in book.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in cells] == [*range(1, len(cells) + 1)]
    outputs = [output for cell in cells for output in cell.outputs]
    assert {output.output_type for output in outputs} <= {
        "stream",
        "execute_result",
        "display_data",
    }
    assert any("image/png" in output.get("data", {}) for output in outputs)
    text = "".join(cell.source for cell in book.cells if cell.cell_type == "markdown")
    assert re.search(r"It needs\s`pip install marl-explore notebook`", text)
    assert "{nb-download}" not in text
    assert all(link.startswith("https://") for link in re.findall(r"\]\((.*?)\)", text))
    links = [a["href"] for a in pages[SITE / f"tutorials/{name}.html"].select("a[download]")]
    assert sum(link.endswith(f"/{name}.ipynb") for link in links) == 1


def test_what_the_tutorials_say_is_true():
    plan = printed("plan")
    assert re.search(r"^flat.png +14 x 20 +0.500 +\d+ +1.000 ", plan, re.MULTILINE)
    best, nearest = map(int, re.findall(r"a complete map after (\d+) steps", plan))
    assert best < nearest
    rows = re.findall(r"^ *(\S+): +\d+% complete, +(\S+) steps", printed("train"), re.M)
    steps = {name: float(value) for name, value in rows}
    assert steps["nearest-timer"] < steps["learned"] < 0.8 * steps["random"]
    first, last = map(float, re.findall(r"(-\d\.\d+) at", printed("happo")))
    assert last > first + 0.3


def build(folder, *options):
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-n", "-q", *options]
    return subprocess.run(
        [*command, folder, folder / "site"], capture_output=True, text=True, timeout=600
    )


def test_what_is_broken_is_an_error(tmp_path):
    shutil.copy(DOCS / "conf.py", tmp_path)
    (tmp_path / "index.md").write_text(
        "# Index\n\n[a](page.md)\n[b](page.md#nothing)\n[c](nowhere.md)\n[d](../nothing.py)\n\n"
        "![e](nothing.png)\n"
    )
    (tmp_path / "page.md").write_text("# A page that is in no contents\n")
    done = build(tmp_path)
    assert done.returncode == 1
    for what in ("nothing'", "nowhere.md", "nothing.py", "nothing.png", "toctree"):
        assert what in done.stderr
    cell = "---\nfile_format: mystnb\nkernelspec:\n  name: python3\n---\n# A\n\n"
    (tmp_path / "page.md").unlink()
    (tmp_path / "index.md").write_text(cell + "```{code-cell} ipython3\nassert 1 == 2\n```\n")
    done = build(tmp_path)
    assert done.returncode != 0
    assert "AssertionError" in done.stderr
