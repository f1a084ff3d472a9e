"""Let robots with wheels and lidars explore the paper's lab, in simulation.

marl-explore lab runs/my-run --out lab

It needs ``pip install ".[lab]"``. Writes the paper's lab figures (best and merged map over steps;
of the first arena, each robot's explored area beside the view from above) and the measurements;
docs/robots.md explains them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from marl_explore.cli.common import parse_options
from marl_explore.config.checks import require_integer


@dataclass(frozen=True)
class Measured:
    """Standard deviations of the measurement noise."""

    range_share: float = 0.02
    """Of a range, as a fraction of it."""
    position: float = 0.01
    """Of x and y (metres)."""
    heading: float = 0.0175
    """Of yaw (radians)."""


@dataclass(frozen=True)
class Arguments:
    """Options of ``marl-explore lab``."""

    policy: Annotated[str, tyro.conf.Positional]
    """Run folder, policy file, bundled policy, or a planner."""
    layouts: int = 20
    """Number of test arenas."""
    steps: int = 60
    """Number of grid steps."""
    seed: int = 0
    """Seed of arenas, noise and sampled actions."""
    noise: Measured = field(default_factory=Measured)
    picture: bool = False
    """Whether to write arena.png too, the first arena at the end; needs OpenGL (EGL)."""
    out: Path = Path("lab")
    """New folder for lab.png, explored.png and lab.json."""

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("layouts", self.layouts, 1)
        require_integer("steps", self.steps, 1)
        require_integer("seed", self.seed, 0)


def parse(words: Sequence[str], prog: str = "marl-explore lab") -> Arguments:
    """Parse a command line."""
    return parse_options(Arguments, words, prog, __doc__)


def run(arguments: Arguments) -> None:
    """Explore, print the measurements, and write them with the figure."""
    from matplotlib import image

    from marl_explore import PLANNERS, ArenaConfig, ExplorationEnv, load_policy
    from marl_explore.evaluation.episodes import TEST_STREAM
    from marl_explore.evaluation.plots import explored_figure, lab_figure
    from marl_explore.lab import LabRunner, Noise, planner_policies
    from marl_explore.utils import records

    record = records.provenance() | {"settings": asdict(arguments)}
    if arguments.policy in PLANNERS:
        config = ArenaConfig()
        policy = planner_policies(arguments.policy, config, arguments.seed)
    else:
        policy = load_policy(arguments.policy)
        config = policy.config.arena
    records.require_new(arguments.out)
    env = ExplorationEnv(config, arguments.layouts, seed=arguments.seed, stream=TEST_STREAM)
    start = env.reset()
    arenas = start["obstacles"], start["agents", "position"]
    noise = Noise(**asdict(arguments.noise))
    lab = LabRunner(policy, arenas, noise, config, seed=arguments.seed)
    explored = lab.run(arguments.steps)
    folder = records.new_folder(arguments.out)
    if arguments.picture:
        image.imsave(folder / "arena.png", lab.world.render())
    lab_figure(explored.coverage(), folder / "lab.png")
    first = explored.obstacles[0], explored.maps[0], explored.cells[0]
    explored_figure(*first, folder / "explored.png")
    summary = explored.summary()
    coverage = {name: curve.mean(0).tolist() for name, curve in explored.coverage().items()}
    settings = record["settings"] | {"out": str(arguments.out)}
    records.write_json(
        folder / "lab.json",
        {"run": record | {"settings": settings}, "summary": summary, "mean coverage": coverage},
    )
    for name, value in summary.items():
        print(f"{name:>22} {value:.4g}")
