"""Presets: the paper's numbers."""

from __future__ import annotations

import pytest

from marl_explore import ArenaConfig
from marl_explore.training.presets import PRESETS


@pytest.mark.parametrize("name", [name for name in PRESETS if name.startswith("paper")])
def test_paper_presets_have_the_papers_numbers(name):
    preset = PRESETS[name]
    _, network, reward = name.split("-")
    assert (preset.network.name, preset.reward) == (network, reward)
    assert preset.arena == ArenaConfig()
    assert (preset.episodes, preset.episode_steps) == (5000, 200)
    assert preset.num_envs * preset.rollout_steps == 8 * preset.episode_steps
    assert preset.updates == 625
    assert (preset.clip_epsilon, preset.ppo_epochs, preset.num_minibatches) == (0.2, 5, 1)
    assert preset.actor_lr == preset.critic_lr == 5e-4
    assert preset.network.hidden == {"mlp": (2400, 300), "cnn": 300}[network]
