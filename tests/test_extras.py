"""Without an optional package, what needs it says in one line how to install it."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from marl_explore import MLP, ArenaConfig, Policy, PolicyConfig, export_onnx

ROOT = Path(__file__).parents[1]
PIP = 'pip install "marl-explore[{}]"'
BENCHMARL = 'docs/happo.md ("In BenchMARL")'
NAMES = {
    "ExplorationTask": ("benchmarl", BENCHMARL),
    "HappoConfig": ("benchmarl", BENCHMARL),
    "LabRunner": ("vmas", PIP.format("lab")),
    "Noise": ("vmas", PIP.format("lab")),
    "replay_recording": ("rosbags", PIP.format("ros")),
}
RECIPES = {
    ("benchmarl_exploration.py", "benchmarl"): BENCHMARL,
    ("foreign_maps.py pursuit", "pygame"): PIP.format("pursuit"),
    ("happo_pettingzoo.py", "mpe2"): ".[mpe]",
    ("happo_vmas.py", "vmas"): ".[lab]",
    ("rllib_ppo.py", "ray"): PIP.format("rllib"),
    ("sb3_ppo.py", "stable_baselines3"): PIP.format("sb3"),
}
ELSEWHERE = {"export_onnx"}  # can be imported, and is tested below


def without(package, program, *arguments):
    """Run a program in which a package is missing."""
    hidden = f"import sys; sys.modules[{package!r}] = None\n"
    command = [sys.executable, "-c", hidden + program, *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)


def test_the_table_of_the_documentation_is_what_is_tested():
    table = (ROOT / "docs" / "api.md").read_text().split("## Names that need an extra")[1]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    assert {name for row in rows for name in re.findall(r"`(\w+)`", row)} == {*NAMES, *ELSEWHERE}


@pytest.mark.parametrize("name", NAMES)
def test_names_say_what_is_missing_and_how_to_install_it(name):
    package, install = NAMES[name]
    done = without(package, f"from marl_explore import {name}")
    last = done.stderr.splitlines()[-1]
    assert last.startswith(f"ModuleNotFoundError: this needs {package}: ")
    assert install in last
    assert done.stderr.count("Traceback") == 1


def test_the_adapter_itself_says_it_too():
    done = without("benchmarl", "import marl_explore.adapters.benchmarl")
    last = done.stderr.splitlines()[-1]
    assert last.startswith("ModuleNotFoundError: this needs benchmarl: ")
    assert BENCHMARL in last


@pytest.mark.parametrize("package", ["onnx", "onnxscript"])
def test_an_export_says_it_and_writes_nothing(package, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, package, None)
    config = PolicyConfig(ArenaConfig(), MLP(hidden=(8,)))
    with pytest.raises(ModuleNotFoundError, match="this needs onnx(script)?: pip install .*export"):
        export_onnx(Policy(config, config.make_actors()), tmp_path / "onnx")
    assert not (tmp_path / "onnx").exists()


@pytest.mark.parametrize(("recipe", "package"), RECIPES)
def test_recipes_say_it_in_one_line(recipe, package):
    name, *words = recipe.split()
    run = (
        f"sys.path.insert(0, 'recipes'); sys.argv = [{name!r}, *sys.argv[1:]]\n"
        f"import runpy; runpy.run_path('recipes/{name}', run_name='__main__')"
    )
    done = without(package, run, *words)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.startswith(f"error: this program needs {package}: ")
    assert RECIPES[recipe, package] in line
