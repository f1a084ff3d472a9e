"""A whole training iteration against that of HARL, the reference implementation of HAPPO.

python -m benchmarks.harl PATH_OF_CLONE

It takes a clone of https://github.com/PKU-MARL/HARL, and setproctitle and absl-py, which HARL
imports. Both have the same numbers of robots, arenas, steps, epochs and minibatches, and networks
of the same inputs and widths. HARL's collection steps an environment that costs nothing, while ours
steps the arenas: the ratio is in HARL's favour.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from importlib import import_module
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
import torch
import yaml
from gymnasium.spaces import Box, Discrete
from torch import nn

from benchmarks.timing import conditions, medians
from benchmarks.training import Iteration
from marl_explore.config.checks import require
from marl_explore.config.constants import NUM_ACTIONS
from marl_explore.policies.networks import MLP
from marl_explore.training.config import TrainConfig
from marl_explore.training.learners import TEAM
from marl_explore.training.presets import PRESETS
from marl_explore.training.trainer import Trainer

RUNNER = Path("harl", "runners", "on_policy_ha_runner.py")
SETTINGS = Path("harl", "configs", "algos_cfgs", "happo.yaml")
PREPARED = 16
"""Random observations of all arenas that HARL's environment returns in turn."""


def load(path: Path) -> ModuleType:
    """The module of HARL's runner that all runners on fresh data extend.

    Raises:
        ValueError: when the path is no clone of HARL.
        ModuleNotFoundError: when a package that HARL imports is missing.
    """
    found = all((path / file).is_file() for file in (RUNNER, SETTINGS))
    require(found, "path", str(path), f"it must be a clone of HARL, with {RUNNER} and {SETTINGS}")
    sys.path.insert(0, str(path.resolve()))
    return import_module("harl.runners.on_policy_base_runner")


class FreeEnvironment:
    """HARL's interface of vectorised environments, with steps that cost nothing.

    Args:
        config: of the arenas, whose shapes it has.
        state_size: of the input of the critic.
    """

    def __init__(self, config: TrainConfig, state_size: int) -> None:
        arenas, robots = config.num_envs, config.arena.num_agents
        size = config.arena.observation_size
        rng = np.random.default_rng(config.seed)
        shape = (PREPARED, arenas, robots)
        self.observations = rng.random((*shape, size), np.float32)
        self.states = rng.random((*shape, state_size), np.float32)
        self.allowed = np.ones((arenas, robots, NUM_ACTIONS), np.float32)
        self.rewards = np.zeros((arenas, robots, 1), np.float32)
        self.done = np.zeros((arenas, robots), bool)
        self.infos: list[list[dict[str, bool]]] = [[{}] * robots] * arenas
        self.infos_at_end = [[{"bad_transition": True}] * robots] * arenas
        self.observation_space = [Box(0, 1, (size,))] * robots
        self.share_observation_space = [Box(0, 1, (state_size,))] * robots
        self.action_space = [Discrete(NUM_ACTIONS)] * robots
        self.episode_steps, self.steps = config.episode_steps, 0

    def reset(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Observations, states and allowed actions."""
        index = self.steps % PREPARED
        return self.observations[index], self.states[index], self.allowed

    def step(self, actions: np.ndarray) -> tuple[Any, ...]:
        """As ``reset``, with rewards, ends of episodes and what HARL reads of truncations."""
        self.steps += 1
        observation, state, allowed = self.reset()
        if self.steps % self.episode_steps == 0:
            return observation, state, self.rewards, ~self.done, self.infos_at_end, allowed
        return observation, state, self.rewards, self.done, self.infos, allowed


class Silence:
    """A logger of HARL that ignores everything."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_: None


def settings(defaults: Path, config: TrainConfig) -> dict[str, dict[str, Any]]:
    """HARL's own settings for HAPPO, with those of a run and a length of one iteration."""
    assert isinstance(config.network, MLP)
    changes: dict[str, dict[str, Any]] = {
        "device": {"cuda": False, "torch_threads": 1},
        "train": {
            "n_rollout_threads": config.num_envs,
            "num_env_steps": config.batch_frames,
            "episode_length": config.rollout_steps,
            "log_interval": 2,  # never in a run of one iteration
            "eval_interval": 2,
            "use_valuenorm": config.value_norm,
            "use_linear_lr_decay": config.lr_decay,
        },
        "eval": {"use_eval": False},
        "model": {
            "hidden_sizes": list(config.network.hidden),
            "use_feature_normalization": False,
            "lr": config.actor_lr,
            "critic_lr": config.critic_lr,
            "opti_eps": config.adam_eps,
        },
        "algo": {
            "ppo_epoch": config.ppo_epochs,
            "critic_epoch": config.ppo_epochs,
            "actor_num_mini_batch": config.num_minibatches,
            "critic_num_mini_batch": config.num_minibatches,
            "clip_param": config.clip_epsilon,
            "entropy_coef": config.entropy_coeff,
            "max_grad_norm": config.max_grad_norm,
            "gamma": config.gamma,
            "gae_lambda": config.lmbda,
        },
    }
    found = yaml.safe_load(defaults.read_text())
    return {part: {**values, **changes.get(part, {})} for part, values in found.items()}


def critic_inputs(trainer: Trainer) -> int:
    """Numbers that the critic reads."""
    layers = trainer.learners[TEAM].critic.modules()
    return next(layer.in_features for layer in layers if isinstance(layer, nn.Linear))


def harl_iteration(harl: ModuleType, config: TrainConfig, state_size: int) -> Callable[[], None]:
    """One iteration of HARL: its runner's own ``run``, without files and logs."""
    environment = FreeEnvironment(config, state_size)
    instead: dict[str, Any] = {
        "make_train_env": lambda *_: environment,
        "get_num_agents": lambda *_: config.arena.num_agents,
        "init_dir": lambda *_, **__: (None,) * 4,
        "save_config": lambda *_: None,
        "setproctitle": SimpleNamespace(setproctitle=lambda _: None),
        "LOGGER_REGISTRY": {"free": lambda *_: Silence()},
    }
    defaults = Path(str(harl.__file__)).parents[2] / SETTINGS
    names = {"algo": "happo", "env": "free", "exp_name": "benchmark"}
    runner_class = import_module("harl.runners.on_policy_ha_runner").OnPolicyHARunner
    with patch.multiple(harl, **instead), redirect_stdout(io.StringIO()):
        runner = runner_class(names, settings(defaults, config), {})

    def run() -> None:
        with redirect_stdout(io.StringIO()):
            runner.run()

    return run


def measure(harl: ModuleType, preset: str, repeats: int = 7) -> dict[str, float]:
    """Median seconds of a whole iteration of each, in turns."""
    config = PRESETS[preset]
    ours = Iteration(config)
    theirs = harl_iteration(harl, config, critic_inputs(ours.trainer))
    seconds = medians({"ours": ours, "HARL": theirs}, repeats)
    ours.trainer.rollouts.close()
    return seconds


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("path", type=Path, help="a clone of https://github.com/PKU-MARL/HARL")
    try:
        harl = load(parser.parse_args(words).path)
    except ValueError as error:
        sys.exit(f"error: {error}")
    except ModuleNotFoundError as error:
        sys.exit(f"error: {error}, which HARL imports")
    torch.set_num_threads(1)
    for preset in ("paper-mlp-case2", "fast"):
        seconds = measure(harl, preset)
        print(f"one iteration of {preset}, {conditions()}")
        for name, value in seconds.items():
            print(f"{name:>8}: {value:8.3f} s")
        ratio = seconds["HARL"] / seconds["ours"]
        print(f"HARL / ours: {ratio:.2f}, in HARL's favour: its environment costs nothing")


if __name__ == "__main__":
    main()
