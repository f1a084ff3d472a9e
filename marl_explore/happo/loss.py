"""HAPPO as a TorchRL loss: one clipped PPO objective per actor, updated one after the other.

Zhong et al., "Heterogeneous-Agent Reinforcement Learning", JMLR 2024. With ``r_i`` the ratio of
actor i's new to its old policy, actor ``i`` of a random order maximises

    E[ min(r_i M A, clip(r_i, 1 - eps, 1 + eps) M A) ],   M = product of r_j over j before i,

and since M > 0 this is the objective of clipped PPO with the advantage M A. So every actor has a
stock ``ClipPPOLoss``, and the TensorDict carries the factor M from one update to the next.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import ValueNorm
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.utils import ValueEstimators, distance_loss
from torchrl.objectives.value import GAE

View = tuple[NestedKey, int]


class HAPPOLoss(LossModule):
    """Losses of a team of actors and their shared critic, for sequential updates.

    One iteration on a batch of any shape ``*B``, the factor absent at first::

        loss.estimate_advantage(batch)          # [*B, T]: advantage, value_target
        for name in loss.update_order(generator):
            ...                                 # epochs of loss.actor_loss(minibatch, name)
            loss.update_factor(batch, name)
        ...                                     # epochs of loss.critic_loss(minibatch)

    ============================ ================= ==============================================
    Entry (``tensor_keys``)      Shape             Meaning
    ============================ ================= ==============================================
    advantage                    [*B, 1]           A, normalised once over the whole batch
    value_target                 [*B, 1]           return the critic regresses on, reward units
    value                        [*B, 1]           the critic's output
    factor                       [*B, 1]           M; absent means 1
    reward, done, terminated     [*B, 1]           of the team, under "next"
    ============================ ================= ==============================================

    Args:
        actors: a probabilistic actor per name; their parameters must not be shared.
        critic: module that writes ``value`` from the joint observation or the state; None for
            actors alone.
        views: per actor the (group, index) it reads: its slice of a stacked group [*B, N, ...].
            An actor without a view reads its own group. Groups may differ in action space. If k
            agents share an actor, [*B, k, ...], each agent's ratio is clipped on its own, as in
            MAPPO, and M is multiplied by their product.
        clip_epsilon: half width of the clipping range of the ratio.
        entropy_coeff: weight of the entropy bonus, not weighted by M.
        value_norm: running statistics that define the critic's units; None: reward units.
        **actor_options: further options of ``ClipPPOLoss``.

    Raises:
        ValueError: without actors, for a view that does not fit, or for shared parameters.
    """

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        factor: NestedKey = "factor"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.GAE

    def __init__(
        self,
        actors: Mapping[str, nn.Module],
        critic: TensorDictModule | None = None,
        *,
        views: Mapping[str, View] | None = None,
        clip_epsilon: float = 0.2,
        entropy_coeff: float = 0.01,
        value_norm: ValueNorm | None = None,
        **actor_options: Any,
    ) -> None:
        super().__init__()
        self.views = dict(views or {})
        _check_parts(actors, critic, self.views)
        self.actor_losses = nn.ModuleDict()
        for name, actor in actors.items():
            self.actor_losses[name] = ClipPPOLoss(
                actor,
                critic_network=None,
                clip_epsilon=clip_epsilon,
                entropy_coeff=entropy_coeff,
                normalize_advantage=False,
                functional=False,
                **actor_options,
            )
        self.critic = critic
        self.value_norm = value_norm

    @property
    def names(self) -> list[str]:
        """Names of the actors."""
        return list(self.actor_losses)

    @property
    def in_keys(self) -> list[NestedKey]:
        """Entries that ``forward`` reads, given an advantage; a factor is optional."""
        keys = [key for name in self.names for key in self.actor_keys(name)]
        keys += self.critic_keys
        in_order = dict.fromkeys(keys)  # each once
        del in_order[self.tensor_keys.factor]
        return list(in_order)

    def actor_keys(self, name: str) -> list[NestedKey]:
        """Entries that ``actor_loss`` reads: minibatches need no others. The factor is optional."""
        return [*self._own_keys(name), self.tensor_keys.advantage, self.tensor_keys.factor]

    @property
    def critic_keys(self) -> list[NestedKey]:
        """Entries that ``critic_loss`` reads: minibatches need no others."""
        read = self.critic.in_keys if self.critic is not None else []
        return [*read, self.tensor_keys.value_target]

    @property
    def out_keys(self) -> list[str]:
        """Losses that ``forward`` returns, without diagnostics."""
        losses = [
            f"{part}_{name}"
            for name in self.names
            for part in ("loss_objective", "loss_entropy")
            if part in self._loss_of(name).out_keys
        ]
        return [*losses, *(["loss_critic"] if self.critic is not None else [])]

    # ------------------------------------------------------------------ losses

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """All losses, with the factor in the TensorDict.

        If it has no advantage, ``estimate_advantage`` runs first.

        Returns:
            Scalars ``loss_objective_<name>``, ``loss_entropy_<name>``, ``loss_critic`` and the
            diagnostics of ``actor_loss`` and ``critic_loss``.
        """
        if tensordict.get(self.tensor_keys.advantage, None) is None:
            tensordict = self.estimate_advantage(tensordict.copy())
        output = TensorDict({}, batch_size=[])
        for name in self.names:
            for key, value in self.actor_loss(tensordict, name).items():
                output.set(f"{key}_{name}", value)
        if self.critic is not None:
            output.update(self.critic_loss(tensordict))
        return output

    def actor_loss(self, tensordict: TensorDictBase, name: str) -> TensorDictBase:
        """One actor's clipped objective with the advantage M A, and its entropy bonus.

        Returns:
            Scalars ``loss_objective`` and ``loss_entropy``, and the diagnostics of
            ``ClipPPOLoss``: entropy, clip_fraction, kl_approx, ESS (over the first batch
            dimension), mean_ratio, max_ratio.
        """
        view = self._view(tensordict, name)
        advantage = tensordict.get(self.tensor_keys.advantage)
        factor = tensordict.get(self.tensor_keys.factor, None)
        if factor is not None:
            advantage = factor * advantage
        return self._loss_of(name)(view.set("advantage", advantage))

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Mean squared error of the critic, in the units of ``value_norm``.

        Returns:
            Scalars ``loss_critic`` and ``explained_variance``.
        """
        if self.critic is None:
            raise ValueError("critic_loss needs a critic, and HAPPOLoss was built with critic=None")
        target = tensordict.get(self.tensor_keys.value_target)
        if self.value_norm is not None:
            target = self.value_norm.normalize(target)
        inputs = tensordict.select(*self.critic.in_keys)
        value = self.critic(inputs).get(self.tensor_keys.value)
        residual = (target - value.detach()).var(correction=0)
        explained = 1 - residual / target.var(correction=0).clamp_min(torch.finfo().eps)
        loss = distance_loss(target, value, loss_function="l2").mean()
        return TensorDict({"loss_critic": loss, "explained_variance": explained}, batch_size=[])

    # ------------------------------------------------------- sequential updates

    def update_order(self, generator: torch.Generator | None = None) -> list[str]:
        """The actors' names in a random order; draw a new one for every batch."""
        order = torch.randperm(len(self.names), generator=generator).tolist()
        return [self.names[i] for i in order]

    @torch.no_grad()
    def update_factor(self, tensordict: TensorDictBase, name: str) -> TensorDictBase:
        """Multiply the factor by an updated actor's ratios, over the full batch.

        Writes ``tensor_keys.factor`` [*B, 1] in place and returns the TensorDict.
        """
        view = self._view(tensordict, name)
        loss = self._loss_of(name)
        keys = loss.tensor_keys
        log_ratio = loss.actor_network.get_dist(view).log_prob(view.get(keys.action))
        log_ratio = log_ratio - view.get(keys.sample_log_prob)
        ratio = log_ratio.reshape(*tensordict.shape, -1).sum(-1, keepdim=True).exp()
        factor = tensordict.get(self.tensor_keys.factor, None)
        return tensordict.set(self.tensor_keys.factor, ratio if factor is None else factor * ratio)

    # ---------------------------------------------------------- value estimation

    def make_value_estimator(
        self, value_type: ValueEstimators | None = None, **hyperparams: Any
    ) -> HAPPOLoss:
        """Choose GAE's ``gamma``, ``lmbda`` and further options; ``average_gae`` defaults to True.

        Raises:
            NotImplementedError: for another estimator than GAE.
        """
        if value_type not in (None, ValueEstimators.GAE):
            raise NotImplementedError(f"HAPPOLoss estimates values with GAE, not {value_type}")
        options = {"gamma": 0.99, "lmbda": 0.95, "average_gae": True, **hyperparams}
        # not a submodule: it refers to the critic again, and its settings are not state
        self.__dict__["_value_estimator"] = GAE(value_network=self._value_network(), **options)
        self._forward_value_estimator_keys()
        return self

    @torch.no_grad()
    def estimate_advantage(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run GAE over a rollout [*B, T] and update the value statistics, once per batch.

        Writes advantage, value_target and value (also under "next") in place and returns the
        TensorDict. Truncated episodes bootstrap from the value of their last next observation.

        Raises:
            ValueError: for padded trajectories, since the losses would include the padding.
        """
        if tensordict.get(("collector", "mask"), None) is not None:
            raise ValueError(
                "the batch holds ('collector', 'mask'): padded trajectories are not supported, "
                "collect with split_trajs=False"
            )
        if self._value_estimator is None:
            self.make_value_estimator()
        self.value_estimator(tensordict)
        if self.value_norm is not None:
            self.value_norm.update(tensordict.get(self.tensor_keys.value_target))
        return tensordict

    def _value_network(self) -> TensorDictModule:
        """The critic in reward units."""
        if self.critic is None:
            raise ValueError("value estimation needs a critic, and HAPPOLoss has critic=None")
        if self.value_norm is None:
            return self.critic
        value = [self.tensor_keys.value]
        return TensorDictSequential(
            self.critic, TensorDictModule(self.value_norm.denormalize, value, value)
        )

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        if self._value_estimator is not None:
            keys = self.tensor_keys
            self._value_estimator.set_keys(
                advantage=keys.advantage,
                value_target=keys.value_target,
                value=keys.value,
                reward=keys.reward,
                done=keys.done,
                terminated=keys.terminated,
            )

    # -------------------------------------------------------------------- views

    def _loss_of(self, name: str) -> Any:
        if name not in self.actor_losses:
            raise ValueError(f"actor {name!r} is unknown: the actors are {self.names}")
        return self.actor_losses[name]

    def _own_keys(self, name: str) -> list[NestedKey]:
        """Entries that an actor's loss reads, except the advantage."""
        loss = self._loss_of(name)
        keys = loss.tensor_keys
        produced = {keys.action, keys.sample_log_prob}
        needed = [k for k in loss.actor_network.in_keys if k not in produced]
        return [*needed, keys.action, keys.sample_log_prob]

    def _view(self, tensordict: TensorDictBase, name: str) -> TensorDictBase:
        """The entries of one actor: its slice of a stacked group, or its own group."""
        keys = self._own_keys(name)
        if name not in self.views:
            return tensordict.select(*keys)
        group, index = self.views[name]
        axis = tensordict.ndim
        entries = TensorDict({}, batch_size=tensordict.batch_size, device=tensordict.device)
        for key in keys:
            entry: Tensor = tensordict.get(key)
            entries.set(key, entry.select(axis, index) if _in_group(key, group) else entry)
        return entries


def _in_group(key: NestedKey, group: NestedKey) -> bool:
    path, prefix = (k if isinstance(k, tuple) else (k,) for k in map(unravel_key, (key, group)))
    return path[: len(prefix)] == prefix


def _check_parts(
    actors: Mapping[str, Any], critic: nn.Module | None, views: Mapping[str, View]
) -> None:
    if not actors:
        raise ValueError("actors={} is empty: HAPPOLoss needs at least one actor")
    for name, (group, _) in views.items():
        if name not in actors:
            raise ValueError(f"views[{name!r}] belongs to no actor: they are {list(actors)}")
        keys = actors[name].in_keys
        if not any(_in_group(key, group) for key in keys):
            raise ValueError(f"views[{name!r}] is of the group {group!r}, but it reads {keys}")
    owners: dict[int, str] = {}
    for name, part in {**actors, "critic": critic}.items():
        for parameter in part.parameters() if part is not None else ():
            owner = owners.setdefault(id(parameter), name)
            if owner != name:
                raise ValueError(
                    f"{owner!r} and {name!r} share parameters: an update of one would move the "
                    "other"
                )
