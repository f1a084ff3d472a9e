"""The examples of the README and of docs/ run as they stand; commands and scripts are readable."""

from __future__ import annotations

import importlib
import pkgutil
import re
import shlex
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import marl_explore
from marl_explore import FEATURES, NETWORKS, PLANNERS, PRESETS, RunConfig
from marl_explore.training.run_folder import prepare
from recipes import train_ray

ROOT = Path(__file__).parents[1]
PAGES = (
    "README.md",
    "docs/adapters.md",
    "docs/api.md",
    "docs/benchmark.md",
    "docs/extending.md",
    "docs/happo.md",
    "docs/maps.md",
    "docs/planners.md",
    "docs/replay.md",
    "docs/transforms.md",
)
GAP = re.compile(r"^ *\.\.\.", re.MULTILINE)
"""A line that leaves something to the reader: such a block is not run."""
BLOCKS = [
    (page, block)
    for page in PAGES
    for block in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    if not GAP.search(block)
]


def test_there_are_examples():
    assert {page for page, _ in BLOCKS} == {*PAGES}


@pytest.mark.parametrize(("page", "block"), BLOCKS, ids=range(len(BLOCKS)))
def test_example(page, block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples may write files
    registries = (FEATURES, NETWORKS, PLANNERS)  # and add rows to these
    before = [dict(registry) for registry in registries]
    module = ModuleType("example")
    monkeypatch.setitem(sys.modules, "example", module)
    try:
        exec(compile(block, page, "exec"), module.__dict__)
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


FENCED = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
SCALING = [
    block for kind, block in FENCED.findall((ROOT / "docs/scaling.md").read_text()) if not kind
]
SCRIPTS = [block for block in SCALING if block.startswith("#!/bin/bash\n")]
COMMANDS = re.findall(
    r"^ *(?:exec )?((?:marl-explore|python recipes/train_ray.py) .*)$",
    "".join(SCALING),
    re.MULTILINE,
)


def test_there_are_scripts_and_commands():
    assert len(SCRIPTS) == 2
    assert all(re.search("exec (marl-explore|python recipes/train_ray)", s) for s in SCRIPTS)
    assert len(COMMANDS) >= 9


@pytest.mark.parametrize("script", SCRIPTS, ids=range(len(SCRIPTS)))
def test_bash_reads_the_script(script):
    read = subprocess.run(["bash", "-n"], input=script, text=True, capture_output=True)
    assert (read.returncode, read.stderr) == (0, "")


@pytest.mark.parametrize("command", COMMANDS)
def test_the_program_reads_the_command(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for run in ("runs/fast", "runs/cnn"):  # whose settings a command may take
        prepare(PRESETS["fast"], run, RunConfig())
    program, name, *arguments = shlex.split(command, comments=True)
    if program == "python":
        name, arguments = "train", train_ray.words(arguments)
    read = importlib.import_module(f"marl_explore.cli.{name}").parse(arguments)
    if "resume" in (name, arguments[0]):
        assert str(read.folder) in arguments
    elif len(arguments) > 1:  # the last flag arrived
        flag, value = arguments[-2:]
        name = flag.removeprefix("--").replace("-", "_")
        assert str(getattr(read if hasattr(read, name) else read.run, name)) == value
