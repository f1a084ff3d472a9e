"""HAPPO as a TorchRL loss: one clipped PPO objective per actor, updated one after the other.

Zhong et al., "Heterogeneous-Agent Reinforcement Learning", JMLR 2024. With ``r_i`` the ratio of
actor i's new to its old policy, actor ``i`` of a random order maximises

    E[ min(r_i M A, clip(r_i, 1 - eps, 1 + eps) M A) ],   M = product of r_j over j before i,

and since M > 0 this is the objective of clipped PPO with the advantage M A. So every actor has a
stock ``ClipPPOLoss``, and the TensorDict carries the factor M from one update to the next.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule
from torch import Tensor, nn
from torchrl.modules import ValueNorm
from torchrl.objectives import ClipPPOLoss

from marl_explore.happo.checks import (
    check_batch,
    check_options,
    check_parts,
    check_rows,
    read_column,
    require_column,
    require_finite,
    state_keys,
)
from marl_explore.happo.critic import ESTIMATE, TeamCriticLoss
from marl_explore.happo.policy import TeamPolicy
from marl_explore.happo.ratio import actor_entries, actor_log_ratio, own_keys
from marl_explore.happo.views import View as View
from marl_explore.happo.views import find_views


class HAPPOLoss(TeamCriticLoss):
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
        actors: a probabilistic actor per name; their parameters must not be shared. Recurrent
            ones (``LSTMModule``, ``GRUModule``) are unrolled over whole rows [*B, T] of a rollout.
        critic: module that writes ``value`` from the joint observation or the state; None for
            actors alone.
        views: per actor the (group, index) it reads: its slice of a stacked group [*B, N, ...];
            or (group, (index, ...)) for the agents that share it, of one type, say. An actor
            without a view reads its own group. Groups may differ in action space. If k agents
            share an actor, [*B, k, ...], each agent's ratio is clipped on its own, as in MAPPO,
            and M is multiplied by their product.
        group_map: in place of views, an environment's agents by group; the actors then have the
            names of agents or of whole groups (``views_of``).
        clip_epsilon: half width of the clipping range of the ratio.
        entropy_coeff: weight of the entropy bonus, not weighted by M.
        value_norm: running statistics that define the critic's units; None: reward units.
        **actor_options: further options of ``ClipPPOLoss``: ``checks.ACTOR_OPTIONS``.

    Raises:
        ValueError: without actors; for an actor that has no distribution, writes no
            log-probability or several actions, acts for another's agent or shares its parameters;
            for a view, group_map or option that does not fit.

    Example:
        Two agents of the group "agents", with three discrete actions each:

        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torch import nn
        >>> from torchrl.modules import ProbabilisticActor
        >>> from marl_explore import HAPPOLoss
        >>> def make_actor():
        ...     return ProbabilisticActor(
        ...         TensorDictModule(
        ...             nn.Linear(4, 3), [("agents", "observation")], [("agents", "logits")]
        ...         ),
        ...         in_keys={"logits": ("agents", "logits")},
        ...         out_keys=[("agents", "action")],
        ...         distribution_class=torch.distributions.Categorical,
        ...         return_log_prob=True,
        ...         log_prob_key=("agents", "log_prob"),
        ...     )
        >>> critic = TensorDictModule(nn.Linear(5, 1), ["state"], ["state_value"])
        >>> loss = HAPPOLoss(
        ...     {"left": make_actor(), "right": make_actor()},
        ...     critic,
        ...     group_map={"agents": ["left", "right"]},
        ... )
        >>> loss.views
        {'left': ('agents', 0), 'right': ('agents', 1)}
        >>> ended = torch.zeros(8, 20, 1, dtype=torch.bool)  # of 8 environments, 20 steps
        >>> after = {"state": torch.randn(8, 20, 5), "reward": torch.randn(8, 20, 1)}
        >>> rollout = TensorDict(
        ...     {
        ...         "state": torch.randn(8, 20, 5),
        ...         "agents": {"observation": torch.randn(8, 20, 2, 4)},
        ...         "next": {**after, "done": ended, "terminated": ended},
        ...     },
        ...     batch_size=[8, 20],
        ... )
        >>> with torch.no_grad():
        ...     rollout = loss.make_policy()(rollout)  # in a collector, as a rule
        >>> optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3)
        >>> def descend(value):
        ...     optimizer.zero_grad()
        ...     value.backward()
        ...     optimizer.step()
        >>> batch = loss.estimate_advantage(rollout).reshape(-1)
        >>> for name in loss.update_order():
        ...     losses = loss.actor_loss(batch, name)
        ...     descend(losses["loss_objective"] + losses["loss_entropy"])
        ...     batch = loss.update_factor(batch, name)
        >>> descend(loss.critic_loss(batch)["loss_critic"])
        >>> batch["factor"].shape
        torch.Size([160, 1])
    """

    @dataclass
    class _AcceptedKeys(TeamCriticLoss._AcceptedKeys):
        factor: NestedKey = "factor"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys

    def __init__(
        self,
        actors: Mapping[str, nn.Module],
        critic: TensorDictModule | None = None,
        *,
        views: Mapping[str, View] | None = None,
        group_map: Mapping[str, Sequence[str]] | None = None,
        clip_epsilon: float = 0.2,
        entropy_coeff: float = 0.01,
        value_norm: ValueNorm | None = None,
        **actor_options: Any,
    ) -> None:
        super().__init__(critic, value_norm)
        self.views = find_views(actors, views, group_map)
        check_options(clip_epsilon, entropy_coeff, actor_options)
        check_parts(actors, critic, self.views)
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
        self._states = {name: state_keys(actor) for name, actor in actors.items()}

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

    @property
    def rollout_keys(self) -> list[NestedKey]:
        """Entries of a rollout that an update reads; a collector may leave out others.

        What GAE reads only for options of its own (``auto_reset_env``, ``group_key``) or for n-step
        rewards ("steps_to_next_obs") is not among them.
        """
        keys = self.tensor_keys
        seen = self.critic.in_keys if self.critic is not None else []
        after = [*seen, keys.reward, keys.done, keys.terminated]
        read = [key for key in self.in_keys if key not in (keys.advantage, keys.value_target)]
        return [*read, *(unravel_key(("next", key)) for key in after)]

    def actor_keys(self, name: str) -> list[NestedKey]:
        """Entries that ``actor_loss`` reads: minibatches need no others. The factor is optional."""
        return [*own_keys(self._loss_of(name)), self.tensor_keys.advantage, self.tensor_keys.factor]

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

        Raises:
            ValueError: for an unknown actor, a missing entry, or one of the wrong shape.
            FloatingPointError: for an advantage or factor that is not finite.
        """
        view = self._view(tensordict, name)
        key = self.tensor_keys.advantage
        advantage = read_column(tensordict, key, ESTIMATE.format(name="advantage"))
        factor = self._factor(tensordict)
        if factor is not None:
            advantage = factor * advantage
        require_finite(advantage, f"the factor times {key!r}")
        return self._loss_of(name)(view.set("advantage", advantage))

    # ------------------------------------------------------- sequential updates

    def update_order(self, generator: torch.Generator | None = None) -> list[str]:
        """The actors' names in a random order; draw a new one for every batch."""
        order = torch.randperm(len(self.names), generator=generator).tolist()
        return [self.names[i] for i in order]

    @torch.no_grad()
    def update_factor(self, tensordict: TensorDictBase, name: str) -> TensorDictBase:
        """Multiply the factor by an updated actor's ratios, over the full batch.

        Writes ``tensor_keys.factor`` [*B, 1] in place and returns the TensorDict.

        Raises:
            ValueError: for an unknown actor, a missing entry or one of the wrong shape, and for an
                action that has no probability, such as one that its mask forbids.
            FloatingPointError: when the factor overflows.
        """
        log_ratio = actor_log_ratio(self._loss_of(name), self._view(tensordict, name), name)
        ratio = log_ratio.reshape(*tensordict.shape, -1).sum(-1, keepdim=True).exp()
        factor = self._factor(tensordict)
        factor = ratio if factor is None else factor * ratio
        require_finite(factor, f"the factor after actor {name!r}")
        return tensordict.set(self.tensor_keys.factor, factor)

    def make_policy(self) -> TeamPolicy:
        """The actors as one policy for a collector: each acts for its agent of a group.

        Raises:
            ValueError: when the actors with views do not cover their group.
        """
        actors = {name: self._loss_of(name).actor_network for name in self.names}
        return TeamPolicy(actors, self.views)

    def _loss_of(self, name: str) -> Any:
        if name not in self.actor_losses:
            raise ValueError(f"actor {name!r} is unknown: the actors are {self.names}")
        return self.actor_losses[name]

    def _factor(self, tensordict: TensorDictBase) -> Tensor | None:
        key = self.tensor_keys.factor
        factor: Tensor | None = tensordict.get(key, None)
        if factor is not None:
            require_column(factor, tensordict, key)
        return factor

    def _view(self, tensordict: TensorDictBase, name: str) -> TensorDictBase:
        """The entries of one actor: its slice of a stacked group, or its own group."""
        loss = self._loss_of(name)
        check_batch(tensordict)
        own = actor_entries(loss, tensordict, self.views.get(name), name)
        check_rows(own, self._states[name], name)
        return own
