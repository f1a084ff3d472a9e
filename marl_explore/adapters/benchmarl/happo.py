"""HAPPO as a BenchMARL algorithm."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import torch
from benchmarl.algorithms import Mappo, MappoConfig
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.data import Composite
from torchrl.objectives import LossModule

from marl_explore.happo.diagnostics import FactorWatch
from marl_explore.happo.loss import HAPPOLoss
from marl_explore.happo.update import sequential_update

ONLY = {
    "share_param_critic": True,
    "critic_coef": 1.0,
    "loss_critic_type": "l2",
    "minibatch_advantage": False,
}
"""Settings of MAPPO that HAPPO allows only one value for."""


class Team(TensorDictModuleBase):
    """The actors of a group, each with its own parameters, as the group's policy.

    Args:
        group: name of the group, entries [*B, n, ...].
        actors: a probabilistic actor per agent, for a group of its own, entries [*B, 1, ...].
    """

    def __init__(self, group: str, actors: Mapping[str, TensorDictModuleBase]) -> None:
        super().__init__()
        self.group = group
        self.actors = nn.ModuleDict(actors)
        first = next(iter(actors.values()))
        self.in_keys = [(group, *key[1:]) for key in first.in_keys]
        self.out_keys = [(group, "action"), (group, "log_prob")]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the group's actions and their log-probabilities."""
        apart = self.split(tensordict, self.in_keys)
        for actor in self.actors.values():
            actor(apart)
        for *_, entry in self.out_keys:
            together = torch.cat([apart[name, entry] for name in self.actors], tensordict.ndim)
            tensordict.set((self.group, entry), together)
        return tensordict

    def split(self, tensordict: TensorDictBase, keys: Iterable[Any]) -> TensorDict:
        """Entries of the group, [*B, n, ...], split into its agents' groups, [*B, 1, ...] each."""
        parts: dict[str, dict[str, torch.Tensor]] = {name: {} for name in self.actors}
        for key in keys:
            slices = tensordict.get(key).split(1, tensordict.ndim)
            for name, part in zip(parts, slices, strict=True):
                parts[name][key[1:] if len(key) > 2 else key[1]] = part
        return TensorDict(parts, batch_size=tensordict.batch_size, device=tensordict.device)


class CriticLast(HAPPOLoss):
    """HAPPO's losses; BenchMARL's loop sees only the critic's, after the actors' updates."""

    def __init__(self, *parts: Any, **options: Any) -> None:
        super().__init__(*parts, **options)
        self.reports: dict[str, float] = {}  # of the actors' last update, for BenchMARL's log

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The critic's loss, and the actors' metrics for the log."""
        return self.critic_loss(tensordict).update(self.reports)


class Happo(Mappo):
    """HAPPO for any BenchMARL task: one actor per agent, updated one after the other.

    ``process_batch`` estimates advantages and updates the actors, with the experiment's learning
    rate, epochs, minibatches and gradient clipping; BenchMARL's loop then trains the shared critic.
    The agents of a group get the mean of their rewards. Each group has its own factor.

    Raises:
        ValueError: for settings of MAPPO that HAPPO does not support, and for recurrent models.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        for name, only in ONLY.items():
            if options[name] != only:
                raise ValueError(f"{name}={options[name]!r} is not allowed: HAPPO needs {only!r}")
        if self.has_rnn:
            raise ValueError(f"model_config={self.model_config} is not allowed: it is recurrent")
        self._optimizers: dict[str, torch.optim.Optimizer] = {}
        self._watch = FactorWatch()

    def _get_policy_for_loss(self, group: str, model_config: Any, continuous: bool) -> Team:
        actors = {}
        for i, agent in enumerate(self.group_map[group]):
            name = f"{group}_{i}"
            alone = copy.copy(self)
            alone.group_map = {name: [agent]}
            for kind in ("observation_spec", "action_spec", "action_mask_spec"):
                spec = getattr(self, kind)
                if spec is not None:
                    setattr(alone, kind, Composite({name: spec[group][i : i + 1]}))
            actors[name] = Mappo._get_policy_for_loss(alone, name, model_config, continuous)
        return Team(group, actors)

    def _get_loss(
        self, group: str, policy_for_loss: Team, continuous: bool
    ) -> tuple[LossModule, bool]:
        critic: TensorDictModule = self.get_critic(group)[0]  # the value is the team's
        loss = CriticLast(
            dict(policy_for_loss.actors.items()),
            critic,
            clip_epsilon=self.clip_epsilon,
            entropy_coeff=self.entropy_coef,
        )
        for name in loss.names:
            stock: Any = loss.actor_losses[name]
            stock.set_keys(action=(name, "action"), sample_log_prob=(name, "log_prob"))
        loss.make_value_estimator(gamma=self.experiment_config.gamma, lmbda=self.lmbda)
        return loss, False

    def _get_parameters(self, group: str, loss: Any) -> dict[str, list[nn.Parameter]]:
        return {"loss_critic": list(loss.critic.parameters())}

    def process_batch(self, group: str, batch: TensorDictBase) -> TensorDictBase:
        """Estimate advantages, and update the group's actors one after the other."""
        _share_reward(group, batch)
        loss: Any = self.get_loss_and_updater(group)[0]
        team = self.get_policy_for_loss(group)
        loss.estimate_advantage(batch)
        flat = batch.reshape(-1)
        data = team.split(flat, [*team.in_keys, *team.out_keys])
        data.set("advantage", flat.get("advantage"))
        loss.reports = sequential_update(loss, data, self._minibatches, partial(self._step, loss))
        self._watch(loss.reports["factor_ess"], self.experiment.n_iters_performed + 1)
        return batch

    def process_loss_vals(self, group: str, loss_vals: TensorDictBase) -> TensorDictBase:
        """Does nothing: the only loss left is the critic's."""
        return loss_vals

    def _minibatches(self, data: TensorDictBase, keys: list[NestedKey]) -> Iterator[TensorDictBase]:
        """The minibatches of all passes of an actor."""
        config = self.experiment_config
        size = config.train_minibatch_size(self.on_policy)
        for _ in range(config.n_optimizer_steps(self.on_policy)):
            for rows in torch.randperm(len(data), device=data.device).split(size):
                yield data[rows]

    def _step(self, loss: HAPPOLoss, name: str, losses: TensorDictBase) -> None:
        """One optimiser step of an actor."""
        config = self.experiment_config
        if name not in self._optimizers:
            self._optimizers[name] = torch.optim.Adam(
                loss.actor_losses[name].parameters(),
                lr=config.lr,
                eps=config.adam_eps,
                **config.adam_extra_kwargs,
            )
        optimizer = self._optimizers[name]
        optimizer.zero_grad()
        (losses["loss_objective"] + losses["loss_entropy"]).backward()
        self.experiment._grad_clip(optimizer)
        optimizer.step()


def _share_reward(group: str, batch: TensorDictBase) -> None:
    """Add the team's entries, without an agent axis, if the task has them only per agent."""
    after = batch.get("next")
    reward = after.get((group, "reward"), None)
    if reward is not None:
        after.set("reward", reward.mean(-2))
    for key in ("done", "terminated"):
        if after.get(key, None) is None:
            after.set(key, after.get((group, key)).any(-2))


@dataclass
class HappoConfig(MappoConfig):
    """Settings of HAPPO: those of MAPPO, with the same defaults."""

    @staticmethod
    def associated_class() -> type[Happo]:
        """The algorithm."""
        return Happo

    @classmethod
    def get_from_yaml(cls, path: str | None = None) -> HappoConfig:
        """BenchMARL's settings of MAPPO, or those from a file."""
        theirs = MappoConfig.get_from_yaml(path)
        return cls(**{field.name: getattr(theirs, field.name) for field in fields(theirs)})
