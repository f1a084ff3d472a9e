"""Let robots with wheels and lidars explore the paper's lab in simulation, by a trained policy.

python recipes/lab.py runs/my-run --out lab

It takes ``pip install ".[lab]"``. Writes the paper's lab figure (best and merged map over steps)
and what was measured; docs/robots.md explains it.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore import cli
from marl_explore.config import require_integer


@dataclass(frozen=True)
class Measured:
    """Standard deviations of what robots measure."""

    range_share: float = 0.02
    """Of a range, as a share of it."""
    position: float = 0.01
    """Of x and of y (metres)."""
    heading: float = 0.0175
    """Of yaw (radians)."""


@dataclass(frozen=True)
class Arguments:
    """Which policy, and in how many labs."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run folder, policy file or bundled policy."""
    layouts: int = 20
    """Test arenas."""
    steps: int = 60
    """Steps of the grid."""
    seed: int = 0
    """Seed of arenas, noise and sampled actions."""
    noise: Measured = field(default_factory=Measured)
    picture: bool = False
    """Whether to write arena.png too, the first arena at the end, which takes OpenGL (EGL)."""
    out: Path = Path("lab")
    """New folder for lab.png and lab.json."""

    def __post_init__(self) -> None:
        """Refuse what cannot be."""
        require_integer("layouts", self.layouts, 1)
        require_integer("steps", self.steps, 1)
        require_integer("seed", self.seed, 0)


def parse() -> Arguments:
    """Read the command line."""
    return tyro.cli(Arguments, prog="lab.py", description=__doc__, config=cli.OPTIONS)


def run(arguments: Arguments) -> None:
    """Explore, print what was measured, and write it with the figure."""
    from matplotlib import image

    from marl_explore import ExplorationEnv, load_policy, runs
    from marl_explore.evaluation import TEST_STREAM
    from marl_explore.lab import LabRunner, Noise
    from marl_explore.plots import lab_figure

    record = runs.provenance() | {"settings": asdict(arguments)}
    policy = load_policy(arguments.policy)
    runs.require_new(arguments.out)
    env = ExplorationEnv(
        policy.spec.arena, arguments.layouts, seed=arguments.seed, stream=TEST_STREAM
    )
    start = env.reset()
    arenas = start["obstacles"], start["agents", "position"]
    noise = Noise(**asdict(arguments.noise))
    lab = LabRunner(policy, arenas, noise, seed=arguments.seed)
    explored = lab.run(arguments.steps)
    folder = runs.new_folder(arguments.out)
    if arguments.picture:
        image.imsave(folder / "arena.png", lab.world.render())
    lab_figure(explored.coverage(), folder / "lab.png")
    summary = explored.summary()
    coverage = {name: curve.mean(0).tolist() for name, curve in explored.coverage().items()}
    settings = record["settings"] | {"out": str(arguments.out)}
    runs.write_json(
        folder / "lab.json",
        {"run": record | {"settings": settings}, "summary": summary, "mean coverage": coverage},
    )
    for name, value in summary.items():
        print(f"{name:>22} {value:.4g}")


if __name__ == "__main__":
    cli.main(parse, run)
