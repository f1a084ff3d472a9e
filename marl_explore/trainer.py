"""Training with HAPPO: collect a batch, estimate advantages, update one robot after the other."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from functools import partial

import torch
from tensordict import NestedKey, TensorDictBase
from torch import nn
from torchrl.envs import EnvBase, RewardSum
from torchrl.modules import PopArtValueNorm

from marl_explore.collect import make_collector
from marl_explore.config import TrainConfig
from marl_explore.core.grid import COMMUNICATE, NUM_DIRECTIONS
from marl_explore.core.mapping import known_cells, known_mask, known_targets, target_cells
from marl_explore.happo import HAPPOLoss
from marl_explore.make import make_env
from marl_explore.models import make_critic
from marl_explore.policies import Policy, PolicySpec
from marl_explore.team import probabilistic_actor

VALUE_NORM_DECAY = 0.99
FINAL_LR_SHARE = 0.05


def make_training_env(config: TrainConfig) -> EnvBase:
    """The environment a run is trained on, with episode returns summed up."""
    env = make_env(
        config.arena,
        num_envs=config.num_envs,
        reward=config.reward,
        max_steps=config.episode_steps,
        terminate_at_coverage=config.terminate_at_coverage,
        arenas=config.arenas,
        seed=config.seed,
        fpr=config.fpr,
    )
    env.append_transform(RewardSum())
    return env


class Trainer:
    """One training run: networks, loss, optimisers and collector, and the loop over updates.

    The run is a pure function of its configuration: the global random state is seeded by it.

    Args:
        config: the run.
    """

    def __init__(self, config: TrainConfig) -> None:
        torch.manual_seed(config.seed)
        self.config = config
        spec = PolicySpec(
            config.arena, config.architecture, config.hidden, config.fpr, config.norm_last
        )
        self.policy = Policy(spec, spec.make_actors())
        critic = make_critic(
            config.arena, config.architecture, config.hidden, config.critic_reads, config.norm_last
        )
        names = [f"robot_{i}" for i in range(config.arena.num_agents)]
        self.loss = HAPPOLoss(
            {n: probabilistic_actor(a) for n, a in zip(names, self.policy.actors, strict=True)},
            critic,
            views={name: ("agents", i) for i, name in enumerate(names)},
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_coeff,
            value_norm=PopArtValueNorm(beta=VALUE_NORM_DECAY) if config.value_norm else None,
        )
        self.loss.make_value_estimator(gamma=config.gamma, lmbda=config.lmbda)
        self.optimizers = {
            name: _adam(loss, config.actor_lr, config.adam_eps)
            for name, loss in self.loss.actor_losses.items()
        }
        self.optimizers["critic"] = _adam(critic, config.critic_lr, config.adam_eps)
        self.schedulers = [
            torch.optim.lr_scheduler.LinearLR(opt, 1.0, FINAL_LR_SHARE, config.updates)
            for opt in self.optimizers.values()
            if config.lr_decay
        ]
        if config.compile:
            for network in (*self.policy.actors, critic.module):
                network.compile()
        self.generator = torch.Generator().manual_seed(config.seed)
        self.collector = make_collector(
            partial(make_training_env, config),
            self.policy.team,
            frames_per_batch=config.batch_frames,
            total_frames=config.updates * config.batch_frames,
        )

    def run(self) -> Iterator[dict[str, float]]:
        """Train, yielding the metrics of every update (see docs/metrics.md)."""
        start, frames = time.perf_counter(), 0
        try:
            batches = iter(self.collector)
            for _ in range(self.config.updates):
                batch = self.collect(batches)
                frames += batch.numel()
                metrics = rollout_metrics(batch) | self.update(batch)
                seconds = time.perf_counter() - start
                yield {"frames": frames, "seconds": seconds, "rate": frames / seconds, **metrics}
        finally:
            self.collector.shutdown()

    def collect(self, batches: Iterator[TensorDictBase]) -> TensorDictBase:
        """The collector's next rollout [B, T], the actors run as one network."""
        with self.policy.team.stacked.together():
            return next(batches)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One HAPPO update on a rollout [B, T]: every actor in turn, then the critic."""
        dtype = getattr(torch, self.config.precision)
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            return self._update(batch)

    def _update(self, batch: TensorDictBase) -> dict[str, float]:
        batch = self.loss.estimate_advantage(batch).reshape(-1)
        logs: dict[str, list[float]] = {}
        order = self.loss.update_order(self.generator)
        for previous, name in zip([None, *order], order, strict=False):
            if previous is not None:
                self.loss.update_factor(batch, previous)
            for part in self._minibatches(batch, self.loss.actor_keys(name)):
                output = self.loss.actor_loss(part, name)
                self._step(name, output["loss_objective"] + output["loss_entropy"])
            _log(logs, output, ("entropy", "kl_approx", "clip_fraction"))
        for part in self._minibatches(batch, self.loss.critic_keys):
            output = self.loss.critic_loss(part)
            self._step("critic", output["loss_critic"])
        _log(logs, output, ("loss_critic", "explained_variance"))
        for scheduler in self.schedulers:
            scheduler.step()
        factor = batch.get("factor", torch.ones(1))  # one robot has none
        return {key: sum(values) / len(values) for key, values in logs.items()} | {
            "factor_min": float(factor.min()),
            "factor_max": float(factor.max()),
            "factor_ess": float(factor.sum() ** 2 / factor.square().sum() / factor.numel()),
        }

    def _minibatches(
        self, batch: TensorDictBase, keys: list[NestedKey]
    ) -> Iterable[TensorDictBase]:
        """All passes over some entries of the batch, shuffled and split anew in each."""
        batch = batch.select(*keys, strict=False)
        for _ in range(self.config.ppo_epochs):
            if self.config.minibatches == 1:
                yield batch
                continue
            order = torch.randperm(len(batch), generator=self.generator)
            for rows in order.tensor_split(self.config.minibatches):
                yield batch[rows]

    def _step(self, name: str, loss: torch.Tensor) -> None:
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        loss.backward()
        parameters = optimizer.param_groups[0]["params"]
        nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm)
        optimizer.step()


def rollout_metrics(batch: TensorDictBase) -> dict[str, float]:
    """What a training batch [B, T] shows of the behaviour (see docs/metrics.md)."""
    following = batch["next"]
    agents, action = following["agents"], batch["agents", "action"]
    communicating = action == COMMUNICATE
    useful = communicating & (agents["received"] > 0)
    metrics = {
        "reward": float(following["reward"].mean()),
        "communication_share": float(communicating.float().mean()),
        "useful_share": float(useful.sum() / communicating.sum()),
        "dangerous_share": float(agents["dangerous"].sum() / (action < NUM_DIRECTIONS).sum()),
    }
    ended = following["done"].squeeze(-1)
    if ended.any():
        known = known_mask(agents["map"][ended])
        target = target_cells(following["obstacles"][ended], agents["position"][ended])
        covered = known_targets(known, target).amax(-1) / target.flatten(-2).sum(-1)
        ratio = known_cells(known).amax(-1) / target[0].numel()
        metrics |= {
            "episode_return": float(following["episode_reward"][ended].mean()),
            "episode_steps": float(following["step_count"][ended].float().mean()),
            "final_coverage": float(covered.mean()),
            "final_known_ratio": float(ratio.mean()),
        }
    return metrics


def _adam(network: nn.Module, lr: float, eps: float) -> torch.optim.Adam:
    return torch.optim.Adam(network.parameters(), lr, eps=eps, fused=True)


def _log(logs: dict[str, list[float]], output: TensorDictBase, keys: Iterable[str]) -> None:
    for key in keys:
        logs.setdefault(key, []).append(output[key].item())
