"""Training with HAPPO: collect a batch, estimate advantages, update one robot after the other."""

from __future__ import annotations

import time
from collections.abc import Generator, Iterable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.envs import EnvBase, RewardSum
from torchrl.modules import PopArtValueNorm

from marl_explore.collect import make_collector, require_collector
from marl_explore.config import TrainConfig
from marl_explore.execution import RunConfig
from marl_explore.factor import FactorWatch, factor_statistics
from marl_explore.finite import require_finite, require_finite_batch
from marl_explore.happo import HAPPOLoss
from marl_explore.make import make_env
from marl_explore.models import make_critic
from marl_explore.policies import Policy, PolicySpec
from marl_explore.rollouts import Rollouts
from marl_explore.team import probabilistic_actor
from marl_explore.training_metrics import rollout_metrics

VALUE_NORM_DECAY = 0.99
FINAL_LR_SHARE = 0.05


def make_training_env(
    config: TrainConfig, num_envs: int | None = None, first_arena: int = 0
) -> EnvBase:
    """The environment a run is trained on, or a part of it, with episode returns summed up."""
    env = make_env(
        config.arena,
        num_envs=num_envs or config.num_envs,
        reward=config.reward,
        max_steps=config.episode_steps,
        terminate_at_coverage=config.terminate_at_coverage,
        arenas=config.arenas,
        seed=config.seed,
        first_arena=first_arena,
        fpr=config.fpr,
    )
    env.append_transform(RewardSum())
    return env


class Trainer:
    """One training run: networks, loss, optimisers and rollouts, and the loop over updates.

    In one process the run is a pure function of its configuration, to the last bit, also when it
    is cut in two by ``state_dict`` and ``load_state_dict``: the global random state is seeded by
    it.

    Args:
        config: the run.
        run: how it is carried out; of this only the collector matters here.
    """

    def __init__(self, config: TrainConfig, run: RunConfig | None = None) -> None:
        run = run or RunConfig()
        require_collector(run, config.num_envs)
        make_training_env(config, num_envs=1).reset()  # what is wrong shows here, not in a worker
        torch.manual_seed(config.seed)
        self.config = config
        spec = PolicySpec(
            config.arena,
            config.architecture,
            config.hidden,
            config.fpr,
            config.norm_last,
            config.without,
        )
        self.policy = Policy(spec, spec.make_actors())
        critic = make_critic(
            config.arena, config.architecture, config.hidden, config.critic_reads, config.norm_last
        )
        self.loss = self._make_loss(critic)
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
        self.factor_watch = FactorWatch()
        self.updates, self.seconds = 0, 0.0
        self.rollouts = Rollouts(
            partial(
                make_collector,
                partial(make_training_env, config),
                self.policy.team,
                num_envs=config.num_envs,
                steps=config.rollout_steps,
                run=run,
                seed=config.seed,
            ),
            self.policy.team,
            run,
            config.num_envs,
        )

    def _make_loss(self, critic: TensorDictModule) -> HAPPOLoss:
        config = self.config
        names = [f"robot_{i}" for i in range(config.arena.num_agents)]
        loss = HAPPOLoss(
            {n: probabilistic_actor(a) for n, a in zip(names, self.policy.actors, strict=True)},
            critic,
            views={name: ("agents", i) for i, name in enumerate(names)},
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_coeff,
            value_norm=PopArtValueNorm(beta=VALUE_NORM_DECAY) if config.value_norm else None,
        )
        loss.make_value_estimator(gamma=config.gamma, lmbda=config.lmbda)
        return loss

    @property
    def frames(self) -> int:
        """Steps of single arenas so far."""
        return self.updates * self.config.batch_frames

    def run(self) -> Generator[dict[str, float]]:
        """Train from where the run is, yielding the metrics of every update (docs/metrics.md).

        Raises:
            NonFiniteError: when an observation, loss, gradient or parameter is not finite; the
                update is not counted.
            WorkerError: when workers died again and again; the run is as after the last update.
        """
        start = time.perf_counter() - self.seconds
        try:
            while self.updates < self.config.updates:
                batch = self.collect()
                metrics = rollout_metrics(batch) | self.update(batch)
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

    def collect(self) -> TensorDictBase:
        """The next rollout [B, T]."""
        batch = self.rollouts.next()
        require_finite_batch(batch, self.updates + 1)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """Everything the rest of the run depends on, between two updates."""
        return {
            "updates": self.updates,
            "seconds": self.seconds,
            "loss": self.loss.state_dict(),
            "optimizers": {name: opt.state_dict() for name, opt in self.optimizers.items()},
            "schedulers": [scheduler.state_dict() for scheduler in self.schedulers],
            "generator": self.generator.get_state(),
            "rollouts": self.rollouts.state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a ``state_dict`` of the same configuration, before ``run``.

        Raises:
            ValueError: when the state is of another configuration or number of workers.
        """
        try:
            self.loss.load_state_dict(state["loss"])
            for name, optimizer in self.optimizers.items():
                optimizer.load_state_dict(state["optimizers"][name])
            for scheduler, saved in zip(self.schedulers, state["schedulers"], strict=True):
                scheduler.load_state_dict(saved)
            self.generator.set_state(state["generator"])
            self.updates, self.seconds = state["updates"], state["seconds"]
            self.rollouts.load(state["rollouts"], done=self.updates)
        except KeyError as error:
            raise ValueError(f"the state does not fit this run: it has no {error}") from error
        except RuntimeError as error:
            first = str(error).split("\n\t")[:2][-1]  # torch lists all that differ
            raise ValueError(f"the state does not fit this run: {first}") from error

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """One HAPPO update on a rollout [B, T]: every actor in turn, then the critic."""
        dtype = getattr(torch, self.config.precision)
        with torch.autocast("cpu", dtype, enabled=dtype != torch.float32):
            return self._update(batch)

    def _update(self, batch: TensorDictBase) -> dict[str, float]:
        batch = self.loss.estimate_advantage(batch).reshape(-1)
        learned = ((key, batch[key]) for key in ("advantage", "value_target"))
        require_finite(learned, self.updates + 1, "critic")
        logs: dict[str, list[float]] = {}
        order = self.loss.update_order(self.generator)
        for previous, name in zip([None, *order], order, strict=False):
            if previous is not None:
                self.loss.update_factor(batch, previous)
            for part in self._minibatches(batch, self.loss.actor_keys(name)):
                output = self.loss.actor_loss(part, name)
                self._step(name, output.select("loss_objective", "loss_entropy"))
            _log(logs, output, ("entropy", "kl_approx", "clip_fraction"))
        for part in self._minibatches(batch, self.loss.critic_keys):
            output = self.loss.critic_loss(part)
            self._step("critic", output.select("loss_critic"))
        _log(logs, output, ("loss_critic", "explained_variance"))
        for scheduler in self.schedulers:
            scheduler.step()
        require_finite(self.loss.state_dict().items(), self.updates + 1, "after the update")
        factor = factor_statistics(batch.get("factor", torch.ones(1)))  # one robot has none
        self.factor_watch(factor["factor_ess"], self.updates + 1)
        return {key: sum(values) / len(values) for key, values in logs.items()} | factor

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
                # several times faster than batch[rows], which is an advanced index
                yield batch.apply(
                    lambda entry, rows=rows: entry.index_select(0, rows), batch_size=rows.shape
                )

    def _step(self, name: str, losses: TensorDictBase) -> None:
        require_finite(losses.items(), self.updates + 1, name)
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        sum(losses.values()).backward()
        parameters = optimizer.param_groups[0]["params"]
        norm = nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        if not norm.isfinite():
            named = self.loss.named_parameters()
            gradients = [(f"the gradient of {key}", p.grad) for key, p in named]
            gradients.append(("the norm of all gradients", norm))
            require_finite(gradients, self.updates + 1, name)
        nn.utils.clip_grads_with_norm_(parameters, self.config.max_grad_norm, norm)
        optimizer.step()


def _adam(network: nn.Module, lr: float, eps: float) -> torch.optim.Adam:
    return torch.optim.Adam(network.parameters(), lr, eps=eps, fused=True)


def _log(logs: dict[str, list[float]], output: TensorDictBase, keys: Iterable[str]) -> None:
    for key in keys:
        logs.setdefault(key, []).append(output[key].item())
