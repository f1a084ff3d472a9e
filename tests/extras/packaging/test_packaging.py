"""The package as others get it: built from its source, installed into an empty environment."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from pathlib import Path

import pytest

import marl_explore
from marl_explore.utils.versions import versions

ROOT = Path(__file__).parents[3]
CONSTRAINTS = ROOT / "constraints.txt"
EXTRAS = ("dev", "export", "lab", "mpe", "pursuit", "ray", "ros", "sb3")
ONE_STEP = """
import marl_explore
from marl_explore import make_env
from marl_explore import find_policy

env = make_env(num_envs=2)
env.rollout(1)
policy = find_policy("nearest", marl_explore.ArenaConfig())
print(marl_explore.__file__, policy(env.reset())["agents", "action"].shape[-1])
"""


def run(*command, cwd):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def clean_source(folder):
    """The files a release is made of, without anything that was built before."""
    built = shutil.ignore_patterns("__pycache__", "*.so", "*.pyc", "*.unfinished")
    shutil.copytree(ROOT / "marl_explore", folder / "marl_explore", ignore=built)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, folder)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Paths of all files of the package in its source."""
    source = tmp_path_factory.mktemp("source")
    clean_source(source)
    return {
        path.relative_to(source).as_posix()
        for path in (source / "marl_explore").rglob("*")
        if path.is_file()
    }


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    """An sdist, and a wheel that was built from it."""
    source, out = tmp_path_factory.mktemp("build"), tmp_path_factory.mktemp("dist")
    clean_source(source)
    run(sys.executable, "-m", "build", "--outdir", out, cwd=source)
    (sdist,), (wheel,) = out.glob("*.tar.gz"), out.glob("*.whl")
    return sdist, wheel


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """Python of an environment that has the wheel, what it depends on, and nothing else."""
    folder = tmp_path_factory.mktemp("empty") / "venv"
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    torch = next(
        line for line in CONSTRAINTS.read_text().splitlines() if line.startswith("torch==")
    )
    run(python, "-m", "pip", "install", "-q", "-c", CONSTRAINTS, torch, built[1], cwd=folder)
    return python


def test_both_hold_every_file_of_the_package(built, files):
    sdist, wheel = built
    assert {"marl_explore/py.typed", "marl_explore/evaluation/replay/player.js"} < files
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
    assert files <= names
    kernels = {name for name in names if name.startswith("marl_explore/core/native/_")} - files
    assert {name.split("/")[-1].split(".")[0] for name in kernels} == {
        "_frontier",
        "_goals",
        "_beam",
        "_merging",
        "_paths",
        "_sight",
    }
    assert {n for n in names if n.startswith("marl_explore/")} == files | kernels
    with tarfile.open(sdist) as archive:
        top = sdist.name.removesuffix(".tar.gz")
        assert {f"{top}/{name}" for name in files} <= set(archive.getnames())


def test_the_wheel_declares_extras(built):
    with zipfile.ZipFile(built[1]) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        metadata = archive.read(name).decode()
    for extra in EXTRAS:
        assert f"Provides-Extra: {extra}\n" in metadata


def test_it_works_in_an_empty_environment(installed, tmp_path):
    said = run(installed, "-m", "marl_explore", "--version", cwd=tmp_path)
    lines = dict(line.split(maxsplit=1) for line in said.splitlines())
    assert lines.pop("backend") == "native: C kernel"
    assert lines == versions()
    file, robots = run(installed, "-c", ONE_STEP, cwd=tmp_path).split()
    assert Path(file).is_relative_to(installed.parents[1])
    assert robots == "4"
    policies = "import marl_explore; print(*marl_explore.list_policies())"
    assert run(installed, "-c", policies, cwd=tmp_path).split() == marl_explore.list_policies()


def test_type_checkers_read_its_types(installed, tmp_path):
    (tmp_path / "user.py").write_text(
        "from marl_explore.config.arena import ArenaConfig\nreveal_type(ArenaConfig().height)\n"
    )
    checker = [sys.executable, "-m", "mypy", "--ignore-missing-imports", "--follow-imports=silent"]
    said = run(*checker, "--python-executable", installed, "user.py", cwd=tmp_path)
    assert 'Revealed type is "int"' in said.replace("builtins.", "")
