"""The package's surface: public names, light imports, layers of words."""

from __future__ import annotations

import importlib.util
import inspect
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import marl_explore
from marl_explore.cli.main import COMMANDS
from marl_explore.utils.versions import versions


def test_public_names_resolve():
    for name in marl_explore.__all__:
        found = getattr(marl_explore, name)
        if inspect.isclass(found) or inspect.isfunction(found):
            assert found.__name__ == name
    assert marl_explore.__version__
    assert set(marl_explore.__all__) <= set(dir(marl_explore))


def test_every_file_that_names_the_version_names_the_same():
    root = Path(__file__).parent.parent
    places = {
        "pyproject.toml": r'^version = "(.+)"$',
        "CITATION.cff": r"^version: (.+)$",
        "marl_explore/ros2/setup.py": r'^ +version="(.+)",$',
        "marl_explore/ros2/package.xml": r"<version>(.+)</version>",
        "CHANGELOG.md": r"^## (\d\S*)",
    }
    for file, pattern in places.items():
        found = re.search(pattern, (root / file).read_text(), re.MULTILINE)
        assert found is not None, file
        assert found[1] == marl_explore.__version__, file


def test_unknown_names_are_attribute_errors():
    with pytest.raises(AttributeError, match="no attribute 'Explorer'"):
        _ = marl_explore.Explorer


LIGHT = [
    "marl_explore",
    "marl_explore.__main__",
    "marl_explore.config.arena",
    "marl_explore.config.run",
    "marl_explore.cli.common",
    "marl_explore.cli.main",
    "marl_explore.robot",
]


def command(*arguments):
    """``python -m marl_explore``, with a note of what it imported in the last line."""
    code = (
        "import runpy, sys; sys.argv = ['marl_explore', *sys.argv[1:]]\n"
        "try: runpy.run_module('marl_explore', run_name='__main__')\n"
        "finally: print('torch' in sys.modules)"
    )
    run = [sys.executable, "-c", code, *arguments]
    return subprocess.run(run, capture_output=True, text=True)


@pytest.mark.parametrize("arguments", [(), ("--help",)])
def test_it_says_what_there_is_without_torch(arguments):
    said = command(*arguments)
    assert said.returncode == 0, said.stderr
    assert said.stdout.startswith("usage: marl-explore")
    for name in marl_explore.__all__:
        assert name in said.stdout
    for name in COMMANDS:
        assert f"  {name} " in said.stdout
        assert importlib.util.find_spec(f"marl_explore.cli.{name}"), name
    assert max(map(len, said.stdout.splitlines())) <= 100
    assert said.stdout.splitlines()[-1] == "False"


def test_versions_and_backend():
    lines = command("--version").stdout.splitlines()[:-1]
    found = dict(line.split(maxsplit=1) for line in lines)
    assert found.pop("backend") == marl_explore.backend()
    assert found == versions()
    assert torch.__version__.startswith(found["torch"])
    assert found["marl-explore"] == marl_explore.__version__


def test_an_unknown_flag_is_refused():
    said = command("--verison")
    assert said.returncode == 2
    assert "unrecognized arguments: --verison" in said.stderr


def test_an_unknown_command_is_refused():
    said = command("trian")
    assert said.returncode == 2
    assert "invalid choice: 'trian'" in said.stderr


def test_the_top_of_the_package_holds_four_modules_at_most():
    assert len([*Path(marl_explore.__file__).parent.glob("*.py")]) <= 4


@pytest.mark.parametrize("module", LIGHT)
def test_light_modules_do_not_import_torch(module):
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_the_rules_import_no_torchrl():
    code = "import sys, marl_explore.core.world; sys.exit('torchrl' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
