"""The critic's half of HAPPO's loss: advantages, value statistics and the squared error."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, unravel_key
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from torchrl.modules import ValueNorm
from torchrl.objectives import LossModule
from torchrl.objectives.utils import ValueEstimators, distance_loss
from torchrl.objectives.value import GAE

from marl_explore.happo.checks import (
    check_batch,
    check_reuse,
    read,
    read_column,
    require_column,
    require_finite,
    select,
)
from marl_explore.happo.values import write_shared_values

if TYPE_CHECKING:
    from typing_extensions import Self

ESTIMATE = "call loss.estimate_advantage(rollout) first, or loss.set_keys({name}=...)"
"""What to do when an entry is missing that ``estimate_advantage`` writes."""

OF_AGENTS = {"reward": "mean", "done": "any", "terminated": "any"}
"""How entries [*B, N, 1] of the agents become the team's, [*B, 1]."""
CRITIC = "the critic reads it"


class TeamCriticLoss(LossModule):
    """Value estimation and the loss of a critic of the team; ``HAPPOLoss`` adds the actors.

    Args:
        critic: writes ``tensor_keys.value`` [*B, 1]; None: nothing here can be called.
        value_norm: running statistics that define the critic's units; None: reward units.
    """

    @dataclass
    class _AcceptedKeys:
        advantage: NestedKey = "advantage"
        value_target: NestedKey = "value_target"
        value: NestedKey = "state_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    default_value_estimator = ValueEstimators.GAE

    def __init__(self, critic: TensorDictModule | None, value_norm: ValueNorm | None) -> None:
        super().__init__()
        self.critic = critic
        self.value_norm = value_norm
        self._estimator_options: dict[str, Any] = {}
        self._value_network: _TeamValue | None = None

    @property
    def critic_keys(self) -> list[NestedKey]:
        """Entries that ``critic_loss`` reads: minibatches need no others."""
        inputs = self.critic.in_keys if self.critic is not None else []
        return [*inputs, self.tensor_keys.value_target]

    def critic_loss(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Mean squared error of the critic, in the units of ``value_norm``.

        Returns:
            Scalars ``loss_critic`` and ``explained_variance``.

        Raises:
            ValueError: without a critic, for a missing entry, or for one of the wrong shape.
            FloatingPointError: for a target that is not finite.
        """
        if self.critic is None:
            raise ValueError("critic_loss needs a critic, and HAPPOLoss was built with critic=None")
        check_batch(tensordict)
        key = self.tensor_keys.value_target
        target = read_column(tensordict, key, ESTIMATE.format(name="value_target"))
        require_finite(target, repr(key))
        if self.value_norm is not None:
            target = self.value_norm.normalize(target)
        inputs = select(tensordict, self.critic.in_keys, CRITIC)
        value = team_value(self.critic, inputs, self.tensor_keys.value)
        residual = (target - value.detach()).var(correction=0)
        explained = 1 - residual / target.var(correction=0).clamp_min(torch.finfo().eps)
        loss = distance_loss(target, value, loss_function="l2").mean()
        return TensorDict({"loss_critic": loss, "explained_variance": explained}, batch_size=[])

    def make_value_estimator(
        self,
        value_type: ValueEstimators | None = None,
        *,
        reuse_values: bool = False,
        **hyperparams: Any,
    ) -> Self:
        """Choose GAE's ``gamma``, ``lmbda`` and further options; ``average_gae`` defaults to True.

        Args:
            value_type: None or GAE.
            reuse_values: evaluate an observation that two steps share once, which is about half the
                work. The critic must evaluate every observation on its own; values may differ in
                the last digits, since they are rows of other matrix products.
            hyperparams: of ``torchrl.objectives.value.GAE``.

        Raises:
            ValueError: without a critic; for ``shifted=True``, which leaves steps invalid; and for
                ``reuse_values=True`` with a recurrent critic (``LSTMModule``, ``GRUModule``) or
                with options of how GAE calls the critic.
            NotImplementedError: for another estimator than GAE.
        """
        if value_type not in (None, ValueEstimators.GAE):
            raise NotImplementedError(f"HAPPOLoss estimates values with GAE, not {value_type}")
        if hyperparams.get("shifted"):
            raise ValueError(
                "shifted=True is not allowed: it marks steps as invalid, but the losses use all"
            )
        if self.critic is None:
            raise ValueError("value estimation needs a critic, and HAPPOLoss has critic=None")
        if reuse_values:
            check_reuse(self.critic, hyperparams)
        options = {"gamma": 0.99, "lmbda": 0.95, "average_gae": True, **hyperparams}
        keys = self.tensor_keys
        network = _TeamValue(self.critic, keys.value, self.value_norm)
        estimator = GAE(value_network=None if reuse_values else network, **options)
        estimator.set_keys(
            advantage=keys.advantage,
            value_target=keys.value_target,
            value=keys.value,
            reward=keys.reward,
            done=keys.done,
            terminated=keys.terminated,
        )
        # not submodules: they refer to the critic again, and their settings are not state
        self.__dict__["_value_estimator"] = estimator
        self.__dict__["_value_network"] = network if reuse_values else None
        self._estimator_options = {"reuse_values": reuse_values, **options}
        return self

    @torch.no_grad()
    def estimate_advantage(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Run GAE over a rollout [*B, T] and update the value statistics, once per batch.

        Writes advantage, value_target and value (also under "next") in place and returns the
        TensorDict. Truncated episodes bootstrap from the value of their last next observation.

        Raises:
            ValueError: without a critic, for a batch without samples or a time axis, for a missing
                entry or one that is not the team's, and for padded trajectories, since the losses
                would include the padding.
        """
        if self._value_estimator is None:
            self.make_value_estimator()
        check_batch(tensordict)
        if not tensordict.ndim:
            raise ValueError("the batch is a single step: GAE needs a rollout [*B, T]")
        if tensordict.numel() == 1 and self._estimator_options["average_gae"]:
            raise ValueError(
                f"the batch of shape {[*tensordict.shape]} is a single step, whose advantage "
                "cannot be normalised: see make_value_estimator(average_gae=False)"
            )
        for name, reduction in OF_AGENTS.items():
            key = unravel_key(("next", getattr(self.tensor_keys, name)))
            read_column(
                tensordict,
                key,
                f"HAPPOLoss needs the team's {name} {[*tensordict.shape, 1]}; reduce the agents' "
                f"to it, as in batch[{key!r}] = batch['next', group, {name!r}].{reduction}(-2), or "
                f"name another entry by loss.set_keys({name}=...)",
            )
        for key in self.critic_keys[:-1]:
            read(tensordict, key, CRITIC)
            read(
                tensordict,
                unravel_key(("next", key)),
                f"{CRITIC} for the value after a step; a collector keeps it with compact_obs=False",
            )
        if self._value_network is not None:
            write_shared_values(tensordict, self._value_network, self.tensor_keys.value)
        self.value_estimator(tensordict)
        if self.value_norm is not None:
            self.value_norm.update(tensordict.get(self.tensor_keys.value_target))
        return tensordict

    def _forward_value_estimator_keys(self, **_: Any) -> None:
        if self._value_estimator is not None:
            self.make_value_estimator(**self._estimator_options)


class _TeamValue(TensorDictModuleBase):
    """The critic in reward units, as GAE calls it."""

    def __init__(self, critic: TensorDictModule, key: NestedKey, norm: ValueNorm | None) -> None:
        super().__init__()
        self.critic, self.key = critic, key
        self.norm: Any = norm
        self.in_keys, self.out_keys = critic.in_keys, [key]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        value = team_value(self.critic, tensordict, self.key)
        return tensordict.set(
            self.key, value if self.norm is None else self.norm.denormalize(value)
        )


def team_value(critic: TensorDictModule, inputs: TensorDictBase, key: NestedKey) -> torch.Tensor:
    """The critic's output [*B, 1].

    Raises:
        ValueError: when the critic writes another key, or a value per agent.
    """
    if key not in critic.out_keys:  # not at construction: set_keys may follow
        raise ValueError(
            f"the critic writes {critic.out_keys}, not the value {key!r}: call "
            f"loss.set_keys(value={critic.out_keys[-1]!r})"
        )
    value: torch.Tensor = critic(inputs).get(key)
    require_column(value, inputs, key)
    return value
