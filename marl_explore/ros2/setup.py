"""The package for colcon: the nodes and all of marl_explore, so that robots do not need pip."""

from pathlib import Path

from setuptools import Extension, find_packages, setup

NAME = "marl_explore_ros2"
HERE = Path(__file__).parent
SHARE = f"share/{NAME}"
WORLD = ("merging", "sight", "step")
"""C files of one kernel."""


def files(folder: str) -> list[str]:
    """Files of a folder, for setuptools."""
    return sorted(str(path.relative_to(HERE)) for path in (HERE / folder).iterdir())


def kernels() -> list[Extension]:
    """The C kernels of pyproject.toml; without a compiler the package works with numpy alone."""
    libraries: dict[str, list[str]] = {}
    for path in sorted((HERE / "../core/native").glob("*.c")):
        library = "world" if path.stem in WORLD else path.stem
        # paths relative to this file, as setuptools wants them
        libraries.setdefault(library, []).append(f"../core/native/{path.name}")
    return [
        Extension(
            f"marl_explore.core.native._{library}",
            sources,
            extra_compile_args=["-O3", "-std=c99", "-ffp-contract=off"],
            optional=True,
        )
        for library, sources in libraries.items()
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
