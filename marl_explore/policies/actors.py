"""The actors of a team as one module: the policy of a collector, and HAPPO's actors."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from marl_explore.policies.networks.inputs import by_robot, observation_keys, robots_first
from marl_explore.policies.stacking import UnknownLayerError, stack_modules

ACTION_MASK: NestedKey = ("agents", "action_mask")
ACTION: NestedKey = ("agents", "action")
LOG_PROB: NestedKey = ("agents", "action_log_prob")


class MultiAgentActors(nn.Module):
    """The actors of a team side by side: logits [*B, N, 10] from inputs with a robot axis.

    Args:
        actors: one per robot, or a single one that all robots share.
    """

    def __init__(self, actors: Iterable[nn.Module]) -> None:
        super().__init__()
        self.actors = nn.ModuleList(actors)
        self.inputs: tuple[str, ...] = self.actors[0].inputs  # type: ignore[assignment]
        self._together: list[nn.Module] = []  # in a list, so that it is not a submodule

    @contextmanager
    def together(self) -> Iterator[None]:
        """Run all actors as one network in this context, several times faster on small batches.

        Their weights are copied, so they must not change inside. Actors with layers that cannot be
        stacked run one by one.
        """
        if len(self.actors) > 1:
            with suppress(UnknownLayerError):
                self._together = [stack_modules([*self.actors])]
        try:
            yield
        finally:
            self._together = []

    def forward(self, *inputs: Tensor) -> Tensor:
        """Logits [*B, N, 10]; actor i reads row i, a single one reads all rows."""
        if len(self.actors) == 1:
            return self.actors[0](*inputs)
        if self._together:
            logits = self._together[0](*robots_first(self.inputs, *inputs))
            return logits.movedim(0, -2)
        robots = by_robot(self.inputs, *inputs)
        return torch.stack(
            [actor(*robot) for actor, robot in zip(self.actors, robots, strict=True)], -2
        )


class TeamActor(TensorDictModuleBase):
    """The policy of a collector: all actors in one module, writing actions and log-probabilities.

    It is equivalent to ``probabilistic_actor(MultiAgentActors(actors))`` in a fraction of the time
    that a chain of modules takes. Actions are sampled;
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` selects the argmax instead.
    """

    out_keys: list[NestedKey] = [ACTION, LOG_PROB]  # noqa: RUF012

    def __init__(self, actors: Iterable[nn.Module]) -> None:
        super().__init__()
        self.stacked = MultiAgentActors(actors)
        self.observation_keys = observation_keys(self.stacked.inputs)
        self.in_keys: list[NestedKey] = [*self.observation_keys, ACTION_MASK]

    @property
    def _dtype(self) -> torch.dtype:
        """Dtype of the weights: after ``double()`` a policy computes in float64."""
        return next(self.stacked.parameters()).dtype

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [*B, N] and ("agents", "action_log_prob")."""
        inputs = (tensordict.get(key) for key in self.observation_keys)
        logits = self.stacked(*(entry.to(self._dtype) for entry in inputs))
        logits = logits.masked_fill(~tensordict.get(ACTION_MASK), -torch.inf)
        log_probs = logits.log_softmax(-1)
        likeliest = exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE)
        # argmax of p / e with exponential e is distributed as p
        race = log_probs if likeliest else log_probs.exp() / torch.empty_like(logits).exponential_()
        action = race.argmax(-1)
        tensordict.set(ACTION, action)
        return tensordict.set(LOG_PROB, log_probs.gather(-1, action.unsqueeze(-1)).squeeze(-1))


def probabilistic_actor(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """A masked categorical policy on the entries of the group "agents".

    With one robot's network it acts on that robot's slice of the group (an actor of HAPPO), with
    ``MultiAgentActors`` on the whole group. Actions are sampled;
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` selects the argmax instead.
    """
    logits: NestedKey = ("agents", "logits")
    return ProbabilisticActor(
        TensorDictModule(
            network, observation_keys(cast("Sequence[str]", network.inputs)), [logits]
        ),
        in_keys={"logits": logits, "mask": ACTION_MASK},
        out_keys=[ACTION],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=LOG_PROB,
        default_interaction_type=InteractionType.RANDOM,
    )
