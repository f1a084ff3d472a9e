"""The code of README and docs/ runs as it stands, or says what it needs; commands are readable."""

from __future__ import annotations

import importlib.util
import pkgutil
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import marl_explore
from marl_explore import FEATURES, NETWORKS, PLANNERS, PRESETS, RADIOS, SHAPES, RunConfig
from marl_explore.cli.main import COMMANDS, main
from marl_explore.training.run_folder import prepare
from recipes import train_ray
from tests.helpers.pages import PAGES, ROOT, Block, blocks, commands, read

GAP = re.compile(r"^ *\.\.\.", re.MULTILINE)
"""A line that leaves something to the reader."""
SCRIPT = 'if __name__ == "__main__":'
"""Worker processes import such a block again, so it is run as a file."""
PYTHON = blocks("python")
RUN = [block for block in PYTHON if not block.needs]
SHELL = blocks("sh")
KINDS = {"", "python", "sh", "{code-cell} ipython3", "{toctree}", "{eval-rst}"}
INCLUDED = "{include} ../CHANGELOG.md"
PROGRAMS = re.compile(
    r"^(marl-explore|python|pip|make|git|ray|ros2|srun|colcon|mkdir|cd|\$|#!)\b", re.MULTILINE
)


def name(block: Block) -> str:
    same = [other for other in PYTHON + SHELL if (other.page, other.kind) == block[:2]]
    return f"{block.page}-{block.kind}-{same.index(block)}"


def test_every_page_is_read():
    assert {"README.md", "docs/api.md", "docs/robots.md", "docs/tutorials/plan.md"} <= {*PAGES}
    assert len(RUN) > 60
    assert len(SHELL) > 25


@pytest.mark.parametrize("page", PAGES)
def test_blocks_say_what_they_are(page):
    text = (ROOT / page).read_text()
    found = read(page, text)
    # a fence that is never closed would hide a block from the tests
    assert len(re.findall(r"^ *```", text, re.MULTILINE)) == 2 * len(found)
    kinds = KINDS | ({INCLUDED} if page == "docs/changelog.md" else set())
    assert {block.kind for block in found} <= kinds
    texts = [block.code for block in found if not block.kind]
    assert [text for text in texts if PROGRAMS.search(text)] == [], "give it the kind sh"
    assert [text for text in texts if re.search(r"^(from|import) ", text, re.M)] == [], "python"


@pytest.mark.parametrize("block", PYTHON, ids=name)
def test_what_is_left_to_the_reader_is_said(block):
    compile(block.code, block.page, "exec")
    assert block.needs or not GAP.search(block.code)


@pytest.mark.parametrize("block", RUN, ids=name)
def test_example(block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples may write files
    if SCRIPT in block.code:
        named = re.search(r"^class (\w+)", block.code, re.MULTILINE)
        file = Path(f"{named[1].lower() if named else 'example'}.py")
        file.write_text(block.code)
        run = subprocess.run([sys.executable, file], capture_output=True, text=True)
        assert run.returncode == 0, run.stderr
        return
    registries = (FEATURES, NETWORKS, PLANNERS, RADIOS, SHAPES)  # and add rows to these
    before = [dict(registry) for registry in registries]
    module = ModuleType("example")
    monkeypatch.setitem(sys.modules, "example", module)
    try:
        exec(compile(block.code, block.page, "exec"), module.__dict__)
    finally:
        for registry, rows in zip(registries, before, strict=True):
            registry.clear()
            registry.update(rows)


API = re.split(r"^### ", (ROOT / "docs/api.md").read_text(), flags=re.MULTILINE)[1:]


EXTRAS = re.search(
    r"^## Names that need an extra$(.*?)(?=^## |\Z)",
    (ROOT / "docs/api.md").read_text(),
    re.MULTILINE | re.DOTALL,
)


def test_every_public_name_has_an_example():
    headed = {}
    for entry in API:
        heading, rest = entry.split("\n", 1)
        (example,) = re.findall(r"```python\n(.*?)```", rest, re.DOTALL)
        assert not GAP.search(example)
        headed |= dict.fromkeys(re.findall(r"`([\w.]+)`", heading), example)
    assert EXTRAS is not None
    tabled = {*re.findall(r"`(\w+)`", EXTRAS[1])} & {*dir(marl_explore)}
    assert tabled.isdisjoint(headed)
    assert {*dir(marl_explore)} == {*headed, *tabled, "__version__"}
    for name, example in headed.items():
        assert pkgutil.resolve_name(f"marl_explore.{name}") is not None
        module, _, attribute = name.rpartition(".")
        assert module not in ("", "planners") or attribute in example


def test_every_public_name_is_in_the_reference():
    text = "".join(path.read_text() for path in (ROOT / "docs/reference").glob("*.md"))
    documented = {*re.findall(r":: marl_explore\.(\w+)$", text, re.MULTILINE)}
    modules = {*re.findall(r"automodule:: (marl_explore\.[\w.]+)$", text, re.MULTILINE)}
    missing = {*marl_explore.__all__} - documented
    assert {getattr(marl_explore, name).__name__ for name in missing} <= modules
    assert documented - {"happo", "transforms"} <= {*marl_explore.__all__}
    assert {"marl_explore.happo", "marl_explore.transforms"} <= modules


SCALING = [block.code for block in SHELL if block.page == "docs/scaling.md"]
SCRIPTS = [script for script in SCALING if script.startswith("#!/bin/bash\n")]


def test_there_are_scripts_and_commands():
    assert len(SCRIPTS) == 2
    assert all(re.search("exec (marl-explore|python recipes/train_ray)", s) for s in SCRIPTS)
    own = [line for s in SCALING for line in commands(s) if line[0] in ("marl-explore", "python")]
    assert len(own) >= 9


@pytest.mark.parametrize("script", SCRIPTS, ids=range(len(SCRIPTS)))
def test_bash_reads_the_script(script):
    read = subprocess.run(["bash", "-n"], input=script, text=True, capture_output=True)
    assert (read.returncode, read.stderr) == (0, "")


CHEAP = [
    ["marl-explore", "--version"],
    ["marl-explore", "maps", "draw", "drawn", "--number", "5"],
]
"""Commands of the pages that are run as they are; the others are read by their program."""


@pytest.mark.parametrize("block", SHELL, ids=name)
def test_commands_exist(block, tmp_path, monkeypatch):
    """Every command is one of this package that its program reads, or the block says needs."""
    monkeypatch.chdir(tmp_path)
    for run in ("runs/fast", "runs/cnn", "runs/eight", "runs/five"):  # whose settings are read
        if not Path(run).exists():
            prepare(PRESETS["fast"], run, RunConfig())
    made = {*re.findall(r"--out (\S+)", "".join(b.code for b in SHELL if b.page == block.page))}
    for words in commands(block.code):
        for run in re.findall(r"\bruns/[\w-]+", " ".join(words)):
            assert run in made or block.needs, f"{run} is not made on this page"
        if not _is_ours(words):
            assert block.needs, f"{words} belongs to another program: say # needs: what"


def _is_ours(words: list[str]) -> bool:
    match words:
        case ["marl-explore", option] if option.startswith("-"):
            main([option])
        case ["marl-explore", command, *arguments]:
            assert command in COMMANDS
            Path("maps").mkdir(exist_ok=True)  # whose sizes are read
            shutil.copy(ROOT / "docs/images/plan.png", "maps")
            _read(command, arguments)
        case ["python", "recipes/train_ray.py", *arguments]:
            _read("train", train_ray.words(arguments))
        case ["python", recipe, *_] if recipe.startswith("recipes/"):
            assert (ROOT / recipe).exists()
        case ["python", "-m", module, *_]:
            assert importlib.util.find_spec(module)
        case ["make", target, *variables]:
            makefile = (ROOT / "Makefile").read_text()
            assert re.search(rf"^{re.escape(target)}:", makefile, re.MULTILINE)
            assert all("=" in variable for variable in variables)
        case ["pip", "install", "-e", "."]:
            return True
        case ["pip", "install", *packages]:
            return all(re.match(r"(\.|torch|marl-explore)(\[|$)", package) for package in packages)
        case _:
            return False
    return True


def _read(command: str, arguments: list[str]) -> None:
    arguments = [word.replace("$first", "first") for word in arguments]
    read = importlib.import_module(f"marl_explore.cli.{command}").parse(arguments)
    if command == "resume" or "resume" in arguments[:1]:
        assert str(read.folder) in arguments
    elif command == "train" and len(arguments) > 1:  # the last flag arrived
        flag, value = arguments[-2:]
        field = flag.removeprefix("--").replace("-", "_")
        homes = (read, read.run, read.train, read.train.arena, read.train.network)
        kept = next(getattr(home, field) for home in homes if hasattr(home, field))
        assert str(kept) in (value, f"({value},)")


@pytest.mark.parametrize("words", CHEAP, ids=" ".join)
def test_cheap_command(words, tmp_path, monkeypatch, capsys):
    assert words in [line for block in SHELL for line in commands(block.code)]
    monkeypatch.chdir(tmp_path)
    main(words[1:])
    assert capsys.readouterr().out


def test_a_broken_block_is_found(tmp_path, monkeypatch):
    """What these tests are for: each would fail for a block like these."""
    for code in ("print(undefined)\n", "from marl_explore import no_such_name\n", "1 +\n"):
        with pytest.raises((NameError, ImportError, SyntaxError)):
            test_example(Block("page", "python", code), tmp_path, monkeypatch)
    for code in (
        "marl-explore train fast --no-such-flag 3\n",
        "marl-explore evaluate runs/other random\n",
        "git clone somewhere\n",
        "make nothing\n",
        "pip install another-package\n",
    ):
        with pytest.raises((AssertionError, SystemExit)):
            test_commands_exist(Block("page", "sh", code), tmp_path, monkeypatch)
