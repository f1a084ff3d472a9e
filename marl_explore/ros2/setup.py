"""The package for colcon: the nodes and all of marl_explore, so that robots do not need pip."""

from pathlib import Path

from setuptools import Extension, find_packages, setup

NAME = "marl_explore_ros2"
HERE = Path(__file__).parent
SHARE = f"share/{NAME}"


def files(folder: str) -> list[str]:
    """Files of a folder, for setuptools."""
    return sorted(str(path.relative_to(HERE)) for path in (HERE / folder).iterdir())


def kernels() -> list[Extension]:
    """The C kernels of pyproject.toml; without a compiler the package works with numpy alone."""
    # paths relative to this file, as setuptools wants them
    return [
        Extension(
            f"marl_explore.core.native._{path.stem}",
            [f"../core/native/{path.name}"],
            extra_compile_args=["-O3", "-std=c99", "-ffp-contract=off"],
            optional=True,
        )
        for path in sorted((HERE / "../core/native").glob("*.c"))
    ]


if __name__ == "__main__":
    setup(
        name=NAME,
        version="0.2.0",
        package_dir={"": "../.."},
        packages=find_packages("../..", include=["marl_explore", "marl_explore.*"]),
        ext_modules=kernels(),
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
        description="Robots that explore by a policy or planner, also with SLAM and Nav2.",
        license="MIT",
        entry_points={
            "console_scripts": [
                "explorer_node = marl_explore.ros2.explorer_node:main",
                "robot_node = marl_explore.ros2.robot_node:main",
                "lab_sim = marl_explore.ros2.lab_sim:main",
            ]
        },
    )
