"""Learners: actors, their critic and the optimisers, updated on a batch.

HAPPO has one learner, whose actors, one per robot or type of robots, are updated in turn. MAPPO has
one learner with a single actor that all robots share; HAPPO's update of a single actor is MAPPO's.
IPPO has a learner per robot, each with a critic of that robot's own observation.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import PopArtValueNorm

from marl_explore.happo.loss import HAPPOLoss, View
from marl_explore.happo.update import sequential_update
from marl_explore.policies.actors import MultiAgentActors, probabilistic_actor
from marl_explore.policies.policy import Policy
from marl_explore.training.config import TrainConfig
from marl_explore.training.nan_guard import require_finite

VALUE_NORM_DECAY = 0.99
FINAL_LR_SHARE = 0.05
TEAM = "team"
"""Name of the single learner of HAPPO and MAPPO, and of MAPPO's actor."""


def make_learners(
    config: TrainConfig, policy: Policy, device: torch.device | str = "cpu"
) -> dict[str, Learner]:
    """The learners of a policy's actors, by name, on the device of the policy."""
    if config.algorithm == "mappo":
        team = probabilistic_actor(MultiAgentActors(policy.actors))
        return {TEAM: Learner(config, _loss(config, {TEAM: team}, {}).to(device))}
    kind, groups = ("type" if config.actors == "type" else "robot"), policy.config.groups
    actors = {f"{kind}_{i}": probabilistic_actor(actor) for i, actor in enumerate(policy.actors)}
    views: dict[str, View] = {
        name: ("agents", group if config.actors == "type" else group[0])
        for name, group in zip(actors, groups, strict=True)
    }
    if config.algorithm == "happo":
        return {TEAM: Learner(config, _loss(config, actors, views).to(device))}
    return {
        name: Learner(config, _loss(config, {name: actor}, {name: views[name]}, robot).to(device))
        for robot, (name, actor) in enumerate(actors.items())
    }


def _loss(
    config: TrainConfig,
    actors: Mapping[str, nn.Module],
    views: Mapping[str, View],
    robot: int | None = None,
) -> HAPPOLoss:
    """The loss of actors and of a critic of all observations, or of one robot's."""
    critic = config.network.make_critic(config.arena, config.critic_input, robot)
    loss = HAPPOLoss(
        actors,
        critic,
        views=views,
        clip_epsilon=config.clip_epsilon,
        entropy_coeff=config.entropy_coeff,
        value_norm=PopArtValueNorm(beta=VALUE_NORM_DECAY) if config.value_norm else None,
    )
    loss.make_value_estimator(gamma=config.gamma, lmbda=config.lmbda, reuse_values=True)
    return loss


class Learner:
    """A loss with an optimiser per network, and one update of all of them on a batch.

    Args:
        config: the run.
        loss: of the actors and their critic.
    """

    critic: TensorDictModule

    def __init__(self, config: TrainConfig, loss: HAPPOLoss) -> None:
        assert loss.critic is not None
        self.config, self.loss, self.critic = config, loss, loss.critic
        self.optimizers = {
            name: _adam(actor, config.actor_lr, config.adam_eps)
            for name, actor in loss.actor_losses.items()
        }
        self.optimizers["critic"] = _adam(self.critic, config.critic_lr, config.adam_eps)
        self.schedulers = [
            torch.optim.lr_scheduler.LinearLR(opt, 1.0, FINAL_LR_SHARE, config.updates)
            for opt in self.optimizers.values()
            if config.lr_decay
        ]

    def update(
        self, batch: TensorDictBase, generator: torch.Generator, number: int
    ) -> dict[str, float]:
        """Update every actor in turn, then the critic.

        Args:
            batch: a rollout [B, T]; advantages and values are written into it.
            generator: of the order of actors and of minibatches.
            number: of the update, starting at 1; errors name it.

        Returns:
            Metrics of the losses and the factor (docs/metrics.md).

        Raises:
            NonFiniteError: when an advantage, loss, gradient or parameter is not finite.
        """
        batch = self.loss.estimate_advantage(batch).reshape(-1)
        learned = ((key, batch[key]) for key in ("advantage", "value_target"))
        require_finite(learned, number, "critic")
        passes = partial(self._minibatches, generator=generator)
        step = partial(self._step, number=number)
        metrics = sequential_update(
            self.loss, batch, passes, step, generator, self.config.update_order
        )
        for part in passes(batch, self.loss.critic_keys):
            output = self.loss.critic_loss(part)
            step("critic", output.select("loss_critic"))
        metrics |= {key: output[key].item() for key in ("loss_critic", "explained_variance")}
        for scheduler in self.schedulers:
            scheduler.step()
        require_finite(self.loss.state_dict().items(), number, "after the update")
        return metrics

    def state_dict(self) -> dict[str, Any]:
        """Weights, statistics and the optimisers' state."""
        return {
            "loss": self.loss.state_dict(),
            "optimizers": {name: opt.state_dict() for name, opt in self.optimizers.items()},
            "schedulers": [scheduler.state_dict() for scheduler in self.schedulers],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Load the state of a learner with the same configuration."""
        self.loss.load_state_dict(state["loss"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        for scheduler, saved in zip(self.schedulers, state["schedulers"], strict=True):
            scheduler.load_state_dict(saved)

    def _minibatches(
        self, batch: TensorDictBase, keys: list[NestedKey], generator: torch.Generator
    ) -> Iterable[TensorDictBase]:
        """Minibatches of all passes over some entries of the batch, reshuffled in each pass."""
        batch = batch.select(*keys, strict=False)
        for _ in range(self.config.ppo_epochs):
            if self.config.num_minibatches == 1:
                yield batch
                continue
            order = torch.randperm(len(batch), generator=generator).to(batch.device)
            for rows in order.tensor_split(self.config.num_minibatches):
                # several times faster than batch[rows], which uses advanced indexing
                yield batch.apply(
                    lambda entry, rows=rows: entry.index_select(0, rows), batch_size=rows.shape
                )

    def _step(self, name: str, losses: TensorDictBase, number: int) -> None:
        require_finite(losses.items(), number, name)
        optimizer = self.optimizers[name]
        optimizer.zero_grad()
        sum(losses.values()).backward()
        parameters = optimizer.param_groups[0]["params"]
        norm = nn.utils.get_total_norm([p.grad for p in parameters if p.grad is not None])
        if not norm.isfinite():
            named = self.loss.named_parameters()
            gradients = [(f"the gradient of {key}", p.grad) for key, p in named]
            gradients.append(("the norm of all gradients", norm))
            require_finite(gradients, number, name)
        nn.utils.clip_grads_with_norm_(parameters, self.config.max_grad_norm, norm)
        optimizer.step()


def _adam(network: nn.Module, lr: float, eps: float) -> torch.optim.Adam:
    return torch.optim.Adam(network.parameters(), lr, eps=eps, fused=True)
