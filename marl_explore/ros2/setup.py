"""The package for colcon: both nodes and all of marl_explore, so that robots do not need pip."""

from pathlib import Path

from setuptools import find_packages, setup

NAME = "marl_explore_ros2"
HERE = Path(__file__).parent
SHARE = f"share/{NAME}"


def files(folder: str) -> list[str]:
    """Files of a folder, for setuptools."""
    return sorted(str(path.relative_to(HERE)) for path in (HERE / folder).iterdir())


if __name__ == "__main__":
    setup(
        name=NAME,
        version="0.1.0",
        package_dir={"": "../.."},
        packages=find_packages("../..", include=["marl_explore", "marl_explore.*"]),
        data_files=[
            ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
            (SHARE, ["package.xml"]),
            (f"{SHARE}/launch", files("launch")),
            (f"{SHARE}/config", files("config")),
        ],
        install_requires=["setuptools"],
        extras_require={"test": ["hypothesis", "pytest", "pyyaml"]},
        zip_safe=False,
        maintainer="The marl_explore authors",
        description="Teams of robots that explore, and their lab in simulation.",
        license="MIT",
        entry_points={
            "console_scripts": [
                "robot_node = marl_explore.ros2.robot_node:main",
                "lab_sim = marl_explore.ros2.lab_sim:main",
            ]
        },
    )
