"""HAPPO compared with TorchRL's MAPPO on two different PettingZoo agents: speaker and listener.

python recipes/happo_pettingzoo.py

A speaker sees which landmark is the goal and says one of 3 words; a listener hears it, sees the
landmarks and drives. Needs the extra "mpe": pip install ".[mpe]".
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field

from happo_mappo import Settings, main
from torchrl.envs import EnvBase, MarlGroupMapType, PettingZooWrapper

from marl_explore import require_integer


@dataclass(frozen=True)
class Arguments:
    """Settings of the task and of training."""

    max_steps: int = 25
    """Steps after which an episode is truncated."""
    train: Settings = field(default_factory=lambda: Settings(updates=60, frames=1000, epochs=10))

    def __post_init__(self) -> None:
        """Check the arguments."""
        require_integer("max_steps", self.max_steps, 1)

    def make_env(self, seed: int) -> EnvBase:
        """One group per agent, with its own sizes of observations and actions."""
        from mpe2 import simple_speaker_listener_v4

        env = simple_speaker_listener_v4.parallel_env(max_cycles=self.max_steps)
        with warnings.catch_warnings():  # about the version that it was tested with
            warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested")
            return PettingZooWrapper(env, group_map=MarlGroupMapType.ONE_GROUP_PER_AGENT, seed=seed)


if __name__ == "__main__":
    main(Arguments, __doc__, package="mpe2", extra="mpe")
