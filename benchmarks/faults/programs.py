"""What the isolated processes run; it imports everything, so that each starts in milliseconds."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from marl_explore.cli.main import main
from marl_explore.config.arena import ArenaConfig
from marl_explore.config.run import RunConfig
from marl_explore.policies.networks import MLP
from marl_explore.training import run_folder, runs, seeds
from marl_explore.training.config import TrainConfig
from marl_explore.utils.interrupts import RunInterruptedError

CONFIG = TrainConfig(
    arena=ArenaConfig(height=6, width=6, num_agents=2),
    network=MLP(hidden=(16, 16)),
    episodes=48,
    episode_steps=10,
    num_envs=4,
    rollout_steps=5,
    ppo_epochs=2,
    num_minibatches=2,
    terminate_at_coverage=0.9,
    lr_decay=True,
)
RUN = RunConfig(checkpoint_every=3, validate_every=4, validation_arenas=4, validation_steps=10)


def command(*words: str) -> None:
    """A command line of ``marl-explore``."""
    torch.set_num_threads(1)
    main(words)


def begin_or_resume(folder: str) -> None:
    """Train ``CONFIG`` in a folder, or resume what is there."""
    if (Path(folder) / run_folder.CONFIG_FILE).exists():
        runs.resume(folder, progress=False, patience=30)
    else:
        runs.train(CONFIG, folder, RUN, progress=False)


def begin_or_resume_sweep(folder: str) -> None:
    """Train ``CONFIG`` with two seeds side by side, or resume what is there."""
    try:
        if seeds.is_sweep(folder):
            seeds.resume_sweep(folder)
        else:
            config = replace(CONFIG, episodes=4 * CONFIG.episodes)
            seeds.sweep(config, folder, [0, 1], RUN, jobs=2)
    except RunInterruptedError as interrupted:
        raise SystemExit(interrupted.status) from interrupted
