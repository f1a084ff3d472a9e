"""HAPPO and TorchRL's MAPPO on any environment: what happo_vmas.py and happo_pettingzoo.py share.

The environment has a group per agent (``MarlGroupMapType.ONE_GROUP_PER_AGENT``), each with its own
"observation", "action" (discrete or continuous) and "reward"; the team gets the mean reward. Both
algorithms start from the same weights, and have the same batch sizes, advantages and critic update.
Only the actors' update differs: one after the other with the factor between them (``HAPPOLoss``),
or all on every minibatch without it (``MAPPOLoss``).
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import torch
import tyro
from fitting_networks import make_actor, make_critic
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictSequential
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import Compose, EnvBase, RewardSum, StepCounter, TransformedEnv
from torchrl.modules import PopArtValueNorm
from torchrl.objectives.multiagent import MAPPOLoss
from tqdm import tqdm

from marl_explore import (
    FactorWatch,
    HAPPOLoss,
    Loggers,
    parse_seeds,
    plots,
    records,
    require_finite_batch,
    require_integer,
    require_package,
    run_program,
    sequential_update,
    summarize_seeds,
    tables,
)

ALGORITHMS = ("happo", "mappo")


@dataclass(frozen=True)
class Settings:
    """Settings of both algorithms."""

    updates: int = 50
    """Number of updates of every network, each on one batch."""
    frames: int = 2000
    """Steps of single environments in a batch."""
    num_minibatches: int = 1
    """Minibatches per batch, each with one gradient step."""
    epochs: int = 5
    """Epochs: passes over a batch."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of every network."""
    lr: float = 5e-4
    """Adam's learning rate."""
    gamma: float = 0.99
    """Discount factor per step."""
    lmbda: float = 0.95
    """Lambda of GAE."""
    clip_epsilon: float = 0.2
    """Clipping range epsilon of the ratio."""
    entropy_coeff: float = 0.01
    """Weight of the entropy bonus."""
    max_grad_norm: float = 10.0
    """Largest gradient norm per network."""
    seeds: str = "0-2"
    """Seeds of both algorithms: 0-2 or 0,3."""
    out: Path | None = None
    """New folder for the runs; default: runs/ followed by the time."""

    def __post_init__(self) -> None:
        """Check the settings."""
        for name in ("updates", "frames", "num_minibatches", "epochs"):
            require_integer(name, getattr(self, name), 1)
        parse_seeds(self.seeds)


class Task(Protocol):
    """The task of a recipe, from its command line."""

    @property
    def max_steps(self) -> int:
        """Steps after which an episode is truncated."""

    @property
    def train(self) -> Settings:
        """Settings of the training."""

    def make_env(self, seed: int) -> EnvBase:
        """The environment, with one group per agent."""


def main(kind: type[Task], about: str | None, package: str, extra: str) -> None:
    """The main program of a recipe: parse the command line, train, draw and print."""
    run_program(
        lambda: tyro.cli(
            kind, description=about, config=(tyro.conf.OmitArgPrefixes, tyro.conf.FlagConversionOff)
        ),
        lambda task: run(task, package, extra),
    )


def run(task: Task, package: str, extra: str) -> None:
    """Compare both algorithms on a task that needs a package.

    Raises:
        ValueError: when the package is missing, saying how to install it.
    """
    require_package(package, f'pip install ".[{extra}]"')
    compare(task.make_env, task.max_steps, task.train)


def compare(make_env: Callable[[int], EnvBase], max_steps: int, settings: Settings) -> Path:
    """Train both algorithms with every seed and draw their learning curves.

    Args:
        make_env: makes the environment for a seed.
        max_steps: steps after which an episode is truncated.
        settings: of both algorithms.

    Returns:
        A folder with ``run.json``, ``curves.png`` and ``happo/seed-0/scalars/*.csv``, ...
    """
    seeds = parse_seeds(settings.seeds)
    folder = records.new_folder(settings.out or Path("runs") / time.strftime("%Y%m%d-%H%M%S"))
    records.write_json(folder / "run.json", {"settings": _plain(settings), **records.provenance()})
    runs = {name: [folder / name / f"seed-{seed}" for seed in seeds] for name in ALGORITHMS}
    for name, folders in runs.items():
        for seed, run in zip(seeds, folders, strict=True):
            torch.manual_seed(seed)
            learner = Learner(make_env(seed), max_steps, settings, sequential=name == "happo")
            logger = Loggers("csv", run, _plain(settings), frames=0)
            start = time.perf_counter()
            with _progress_bar(f"{name}, seed {seed}", settings) as bar:
                for frames, metrics in learner.run():
                    logger.log(metrics | {"seconds": time.perf_counter() - start}, frames)
                    bar.update(settings.frames)
            print(f"{name}, seed {seed}: {time.perf_counter() - start:.0f} s", flush=True)
    summary = {name: summarize_seeds(folder / name, seeds) for name in ALGORITHMS}
    records.write_json(folder / "summary.json", summary)
    ended = all("episode_return" in over_seeds for over_seeds in summary.values())
    measure, label = ("episode_return", "return of an episode") if ended else ("reward", "reward")
    curves = {name.upper(): folders for name, folders in runs.items()}
    plots.training_figure(
        curves, folder / "curves.png", {measure: label}, steps="steps of single environments"
    )
    for name, over_seeds in summary.items():
        row = over_seeds[measure]
        found = (row[key] for key in ("mean", "low", "high"))
        mean, low, high = (math.nan if number is None else number for number in found)
        print(f"{name}: {label} {tables.estimate(mean, low, high)}")
    print(f"runs, curves and every metric: {folder}")
    return folder


class Learner:
    """One run of one algorithm.

    Args:
        env: the environment; actors and critic are made to fit its specs.
        max_steps: steps after which an episode is truncated.
        settings: of the run.
        sequential: whether actors are updated as in HAPPO; False: as in MAPPO.
    """

    def __init__(
        self, env: EnvBase, max_steps: int, settings: Settings, sequential: bool = True
    ) -> None:
        self.env, self.max_steps, self.settings = env, max_steps, settings
        self.sequential = sequential
        groups = list(env.group_map)
        actors = {group: make_actor(env, group, settings.hidden) for group in groups}
        critic = make_critic(env, groups, settings.hidden)
        clipping: dict[str, Any] = {
            "clip_epsilon": settings.clip_epsilon,
            "entropy_coeff": settings.entropy_coeff,
        }
        self.loss = HAPPOLoss(actors, critic, value_norm=PopArtValueNorm(beta=0.99), **clipping)
        self.loss.make_value_estimator(gamma=settings.gamma, lmbda=settings.lmbda)
        self.mappo_losses = {  # advantages are already normalised
            group: MAPPOLoss(actor, normalize_advantage=False, functional=False, **clipping)
            for group, actor in actors.items()
        }
        self.optimizers = {
            name: torch.optim.Adam(network.parameters(), settings.lr, eps=1e-5)
            for name, network in {**actors, "critic": critic}.items()
        }
        self.policy = TensorDictSequential(*actors.values())
        self.factor_watch = FactorWatch()

    def run(self) -> Iterator[tuple[int, dict[str, float]]]:
        """Train; yields frames so far and metrics, once per update."""
        frames, updates = self.settings.frames, self.settings.updates
        env = TransformedEnv(self.env, Compose(StepCounter(self.max_steps), RewardSum()))
        collector = Collector(
            env,
            self.policy,
            frames_per_batch=frames,
            total_frames=frames * updates,
            auto_register_policy_transforms=False,
        )
        for update, batch in enumerate(collector, 1):
            require_finite_batch(batch, update)
            metrics = self._share_reward(batch)
            metrics |= self.update(batch)
            self.factor_watch(metrics.get("factor_ess", 1.0), update)
            yield update * frames, metrics
        collector.shutdown()

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One update of every network on a rollout [*B, T]."""
        batch = self.loss.estimate_advantage(batch).reshape(-1)
        if self.sequential:
            metrics = sequential_update(self.loss, batch, self._minibatches, self._step)
        else:
            metrics = self._update_at_once(batch)
        for part in self._minibatches(batch):
            output = self.loss.critic_loss(part)
            self._step("critic", output.select("loss_critic"))
        return metrics | {key: value.item() for key, value in output.items()}

    def _update_at_once(self, batch: TensorDictBase) -> dict[str, float]:
        for part in self._minibatches(batch):
            for name, loss in self.mappo_losses.items():
                self._step(name, loss(part).select("loss_objective", "loss_entropy"))
        return {}

    def _share_reward(self, batch: TensorDictBase) -> dict[str, float]:
        """Write the team's reward, and measure finished episodes."""
        after = batch["next"]
        for key in ("reward", "episode_reward"):
            agents = [after[group, key].mean(-2) for group in self.loss.names]
            after[key] = torch.stack(agents).mean(0)
        ended = after["done"].squeeze(-1)
        measures = {"reward": float(after["reward"].mean())}
        if ended.any():
            measures["episode_return"] = float(after["episode_reward"][ended].mean())
            measures["episode_steps"] = float(after["step_count"][ended].float().mean())
        return measures

    def _minibatches(
        self, batch: TensorDictBase, keys: list[NestedKey] | None = None
    ) -> Iterator[TensorDictBase]:
        for _ in range(self.settings.epochs):
            for rows in torch.randperm(len(batch)).tensor_split(self.settings.num_minibatches):
                yield batch[rows]

    def _step(self, name: str, losses: TensorDictBase) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        sum(losses.values()).backward()
        parameters = optimizer.param_groups[0]["params"]
        norm = self.settings.max_grad_norm
        nn.utils.clip_grad_norm_(parameters, norm, error_if_nonfinite=True)
        optimizer.step()


def _progress_bar(title: str, settings: Settings) -> tqdm[Any]:
    return tqdm(
        total=settings.frames * settings.updates,
        desc=title,
        unit=" steps",
        mininterval=0.2 if sys.stderr.isatty() else 15,  # few lines in a log file
    )


def _plain(settings: Settings) -> Mapping[str, Any]:
    return asdict(settings) | {"out": str(settings.out)}
