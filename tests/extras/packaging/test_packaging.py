"""The package as others get it: built from its source, installed into an empty environment."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tarfile
import venv
import zipfile
from email import message_from_string
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


def run(*command, cwd, **settings):
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | settings
    done = subprocess.run(
        [*map(str, command)], cwd=cwd, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def clean_source(folder):
    """The files a release is made of, without anything that was built before."""
    built = shutil.ignore_patterns("__pycache__", "*.so", "*.pyc", "*.unfinished", "_build")
    for name in ("marl_explore", "docs", "recipes"):
        shutil.copytree(ROOT / name, folder / name, ignore=built)
    for path in ROOT.iterdir():
        if path.is_file() and not path.name.startswith("."):
            shutil.copy(path, folder)


def metadata(wheel):
    """What a wheel says of itself, with the README as the payload."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (n for n in archive.namelist() if n.endswith("METADATA"))
        return message_from_string(archive.read(name).decode())


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
    """An sdist, and a wheel that was built from it: ``make dist`` with the tests' Python."""
    source = tmp_path_factory.mktemp("build")
    clean_source(source)
    # with the environment of the tests as it is
    run("make", "dist", f"VENV={sys.prefix}", "-o", f"{sys.prefix}/installed-dev", cwd=source)
    (sdist,), (wheel,) = (source / "dist").glob("*.tar.gz"), (source / "dist").glob("*.whl")
    return sdist, wheel


@pytest.fixture(scope="module")
def installed(built, tmp_path_factory):
    """Python of an environment that has the wheel, what it depends on, and nothing else.

    It is installed where there is no C compiler.
    """
    folder = tmp_path_factory.mktemp("empty") / "venv"
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    torch = next(
        line for line in CONSTRAINTS.read_text().splitlines() if line.startswith("torch==")
    )
    run(
        *(python, "-m", "pip", "install", "-q", "-c", CONSTRAINTS, torch, built[1]),
        cwd=folder,
        CC="/no/compiler",
    )
    return python


def test_both_hold_every_file_of_the_package(built, files):
    sdist, wheel = built
    assert {"marl_explore/py.typed", "marl_explore/evaluation/replay/player.js"} < files
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if not name.endswith("/")}
    assert files <= names
    kernels = {name for name in names if name.startswith("marl_explore/core/native/_")} - files
    assert {name.split("/")[-1].split(".")[0] for name in kernels} == {
        "_frontier",
        "_goals",
        "_beam",
        "_paths",
        "_world",
    }
    assert {n for n in names if n.startswith("marl_explore/")} == files | kernels
    with tarfile.open(sdist) as archive:
        top = sdist.name.removesuffix(".tar.gz")
        names = set(archive.getnames())
    assert {f"{top}/{name}" for name in files} <= names
    others = ("docs/api.md", "docs/images/explore.png", "recipes/demo.py", "Makefile")
    assert {f"{top}/{name}" for name in others} <= names
    assert not [name for name in names if name.endswith((".so", ".pyc"))]


def test_one_wheel_fits_all_versions_of_python_and_old_systems(built):
    name = built[1].name
    assert f"-{metadata(built[1])['Version']}-cp310-abi3-manylinux" in name
    assert name.endswith("manylinux_2_17_x86_64.whl")


def test_links_of_the_readme_work_outside_the_repository(built):
    said = metadata(built[1])
    links = re.findall(r"\]\(([^)]+)\)", said.get_payload())
    assert len(links) > 10
    assert all(link.startswith(("https://", "#")) for link in links)
    (repository,) = (
        url.split(", ")[1] for url in said.get_all("Project-URL") if url.startswith("Repository")
    )
    ours = [link for link in links if link.startswith(repository)]
    paths = {link.split("#")[0].split("/main/")[1] for link in ours}
    assert paths
    assert [path for path in paths if not (ROOT / path).exists()] == []


def test_the_wheel_declares_extras(built):
    assert {*EXTRAS} <= {*metadata(built[1]).get_all("Provides-Extra")}


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
