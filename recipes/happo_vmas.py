"""HAPPO compared with TorchRL's MAPPO on a VMAS scenario, with continuous actions.

python recipes/happo_vmas.py --scenario navigation

Needs the extra "lab": pip install ".[lab]". VMAS is licensed under the GPLv3.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.resources import files
from pathlib import Path

from happo_mappo import Settings, main
from torchrl.envs import EnvBase, MarlGroupMapType, VmasEnv

from marl_explore import require_integer, require_package


@dataclass(frozen=True)
class Arguments:
    """A scenario, and the settings of training."""

    scenario: str = "navigation"
    """Name of a VMAS scenario."""
    num_envs: int = 60
    """Number of environments side by side."""
    max_steps: int = 100
    """Steps after which an episode is truncated."""
    train: Settings = field(
        default_factory=lambda: Settings(
            updates=60, frames=6000, num_minibatches=4, epochs=10, entropy_coeff=0.0
        )
    )

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("num_envs", self.num_envs, 1)
        require_integer("max_steps", self.max_steps, 1)
        require_package("vmas", 'pip install ".[lab]"')
        folder = Path(str(files("vmas.scenarios")))
        scenarios = {path.stem for path in folder.rglob("*.py")} - {"__init__"}
        if self.scenario not in scenarios:
            raise ValueError(f"scenario={self.scenario!r} is not allowed: use {sorted(scenarios)}")

    def make_env(self, seed: int) -> EnvBase:
        """One group per agent. VMAS gets no step limit of its own, which would be a termination."""
        return VmasEnv(
            self.scenario,
            num_envs=self.num_envs,
            continuous_actions=True,
            seed=seed,
            group_map=MarlGroupMapType.ONE_GROUP_PER_AGENT,
        )


if __name__ == "__main__":
    main(Arguments, __doc__, package="vmas", extra="lab")
