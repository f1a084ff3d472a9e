"""The trainer: collects a batch, updates the learners on it, and can be stopped and resumed."""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping, Sequence
from functools import partial
from statistics import fmean
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase

from marl_explore.config.run import RunConfig
from marl_explore.happo.diagnostics import FactorWatch
from marl_explore.policies.io import load_policy
from marl_explore.policies.policy import Policy
from marl_explore.training.collectors import make_collector, require_collector
from marl_explore.training.config import TrainConfig
from marl_explore.training.environment import make_training_env
from marl_explore.training.learners import make_learners
from marl_explore.training.memory import policy_config, require_training_memory
from marl_explore.training.nan_guard import require_finite_batch
from marl_explore.training.restarts import RestartingCollector
from marl_explore.training.rollout_metrics import METRIC_KEYS, rollout_metrics
from marl_explore.training.scenes import SceneRollouts, join_scenes
from marl_explore.utils.devices import find_device


class Trainer:
    """One training run: a policy, its learners and rollouts, and the loop over updates.

    In one process the run is a pure function of its configuration, bit for bit, even if it is
    stopped and resumed with ``state_dict`` and ``load_state_dict``. It seeds the global random
    state.

    Args:
        config: the run.
        run: execution settings; only the collector and the device matter here.
        fresh: whether the actors start from those of ``config.init_from``; a resumed run gets all
            weights from its checkpoint instead.
    """

    def __init__(
        self, config: TrainConfig, run: RunConfig | None = None, fresh: bool = True
    ) -> None:
        run = run or RunConfig()
        scenes = config.scene_configs
        require_collector(run, scenes[0].num_envs)
        require_training_memory(config)
        self.device = find_device(run.device)
        torch.manual_seed(config.seed)
        self.config = config
        built = policy_config(config)
        self.policy = Policy(built, built.make_actors())
        if fresh and config.init_from is not None:
            self.policy.init_from(load_policy(config.init_from))
        self.policy.to(self.device)
        self.learners = make_learners(config, self.policy, self.device)
        if config.compile:
            critics = [learner.critic for learner in self.learners.values()]
            for network in (*self.policy.actors, *(critic.module for critic in critics)):
                network.compile()
        self.generator = torch.Generator().manual_seed(config.seed)
        self.factor_watch = FactorWatch()
        self.updates, self.seconds = 0, 0.0
        self.rollouts = SceneRollouts([self._collector(scene, run) for scene in scenes])

    def _collector(self, config: TrainConfig, run: RunConfig) -> RestartingCollector:
        """The collector of one scene's rollouts."""
        make = partial(
            make_collector,
            partial(make_training_env, config, device=run.device),
            self.policy.team,
            num_envs=config.num_envs,
            steps=config.rollout_steps,
            run=run,
            seed=config.seed,
            keep=self._rollout_keys,
        )
        return RestartingCollector(make, self.policy.team, run, config.num_envs)

    @property
    def _rollout_keys(self) -> list[NestedKey]:
        """Entries of a rollout that metrics and learners read."""
        read = [key for learner in self.learners.values() for key in learner.loss.rollout_keys]
        return list(dict.fromkeys([*METRIC_KEYS, *read]))

    @property
    def frames(self) -> int:
        """Steps of single arenas so far."""
        return self.updates * self.config.batch_frames

    def run(self) -> Generator[dict[str, float]]:
        """Do the remaining updates, yielding the metrics of each (docs/metrics.md).

        Raises:
            NonFiniteError: when an observation, loss, gradient or parameter is not finite; the
                update is not counted.
            WorkerError: when workers die repeatedly or one fails; the run stays as it was after
                the last update.
        """
        start = time.perf_counter() - self.seconds
        try:
            while self.updates < self.config.updates:
                rollouts = self.collect()
                metrics = mean_of([rollout_metrics(rollout) for rollout in rollouts])
                metrics |= self.update(join_scenes(rollouts))
                self.updates += 1
                self.seconds = time.perf_counter() - start
                yield {
                    "frames": self.frames,
                    "seconds": self.seconds,
                    "rate": self.frames / self.seconds,
                    **metrics,
                }
        finally:
            self.rollouts.close()

    def collect(self) -> list[TensorDictBase]:
        """The next rollout [B, T] of each scene."""
        rollouts = self.rollouts.next()
        for rollout in rollouts:
            require_finite_batch(rollout, self.updates + 1)
        return rollouts

    def state_dict(self) -> dict[str, Any]:
        """Everything that the rest of the run depends on, between two updates."""
        return {
            "updates": self.updates,
            "seconds": self.seconds,
            "learners": {name: one.state_dict() for name, one in self.learners.items()},
            "generator": self.generator.get_state(),
            "rollouts": self.rollouts.state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from a ``state_dict`` of the same configuration; call this before ``run``.

        Raises:
            ValueError: when the state has another configuration or number of workers.
        """
        try:
            for name, learner in self.learners.items():
                learner.load_state_dict(state["learners"][name])
            self.generator.set_state(state["generator"])
            self.updates, self.seconds = state["updates"], state["seconds"]
            self.rollouts.load(state["rollouts"], done=self.updates)
        except KeyError as error:
            raise ValueError(f"the state does not fit this run: it has no {error}") from error
        except RuntimeError as error:
            first = str(error).split("\n\t")[:2][-1]  # torch lists all that differ
            raise ValueError(f"the state does not fit this run: {first}") from error

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One update of every learner on a batch [B, T]; metrics are means over learners."""
        dtype = getattr(torch, self.config.precision)
        number = self.updates + 1
        with torch.autocast(self.device.type, dtype, enabled=dtype != torch.float32):
            each = [
                learner.update(batch.copy(), self.generator, number)
                for learner in self.learners.values()
            ]
        metrics = mean_of(each)
        self.factor_watch(metrics["factor_ess"], number)
        return metrics


def mean_of(metrics: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Means of metrics over parts of a batch or learners, each over those that have it."""
    names = dict.fromkeys(name for one in metrics for name in one)
    return {name: fmean(one[name] for one in metrics if name in one) for name in names}
