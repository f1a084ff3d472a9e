"""The package as colcon builds it, and its tests there."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import tomllib
import yaml

from tests.extras.ros2.conftest import ROOT


def test_it_is_built_as_an_ament_package(workspace):
    index = workspace.install / "share/ament_index/resource_index/packages/marl_explore_ros2"
    assert index.is_file()
    kind = ElementTree.parse(workspace.share / "package.xml").find("export/build_type")
    assert kind.text == "ament_python"
    for program in ("robot_node", "lab_sim"):
        assert (workspace.install / "lib" / "marl_explore_ros2" / program).is_file()
    for folder in ("launch", "config"):
        installed = {path.name for path in (workspace.share / folder).iterdir()}
        source = {path.name for path in (ROOT / "marl_explore/ros2" / folder).iterdir()}
        assert installed == source >= {"lab.launch.xml" if folder == "launch" else "lab.yaml"}


def test_its_tests_pass_and_none_is_lost(workspace):
    collected = workspace.run("python", "-m", "pytest", "-q", "--collect-only", ROOT / "tests/ros2")
    count = int(re.search(r"(\d+) tests collected", collected)[1])
    assert count >= 25
    workspace.run("colcon", "test", "--paths", workspace.package)
    result = workspace.run("colcon", "test-result", "--all")
    assert f"Summary: {count} tests, 0 errors, 0 failures, 0 skipped" in result


def test_launch_files_name_what_is_installed(workspace):
    for path in (workspace.share / "launch").iterdir():
        for node in ElementTree.parse(path).iter("node"):
            assert node.get("pkg") == "marl_explore_ros2"
            assert (workspace.install / "lib" / node.get("pkg") / node.get("exec")).is_file()


def test_a_robot_needs_no_torch(workspace):
    code = (
        "import sys, marl_explore.ros2.robot_node as n; print(n.__file__, 'torch' in sys.modules)"
    )
    file, torch = workspace.run("python", "-c", code).split()
    assert file.startswith(str(workspace.install))
    assert torch == "False"


def test_its_kernels_are_built(workspace):
    """In a folder of their own: none of those of an installed marl_explore is used."""
    code = (
        "from marl_explore.core import native; "
        "print(native.__file__, [native.missing(name) for name in native.get_args(native.Kernel)])"
    )
    file, missing = workspace.run("python", "-c", code).split(maxsplit=1)
    assert file.startswith(str(workspace.install))
    assert set(missing.strip(" []\n").split(", ")) == {"None"}


def test_the_package_says_what_the_project_says(workspace):
    package = ElementTree.parse(workspace.share / "package.xml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    (author,) = project["authors"]
    set_up = (workspace.package / "setup.py").read_text()
    for tag, name, told in (
        ("version", "version", project["version"]),
        ("license", "license", project["license"]),
        ("maintainer", "maintainer", author["name"]),
    ):
        assert package.find(tag).text == told
        assert f'{name}="{told}"' in set_up
    assert yaml.safe_load((workspace.share / "config/lab.yaml").read_text())
