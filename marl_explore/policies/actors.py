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
from torch.distributions import Categorical
from torchrl.envs import ExplorationType
from torchrl.envs.utils import exploration_type
from torchrl.modules import MaskedCategorical, ProbabilisticActor

from marl_explore.core.motion import give_way
from marl_explore.core.ways import make_room
from marl_explore.planners.goal_moves import follow, goes_to_and_fro
from marl_explore.policies.networks.inputs import by_robot, observation_keys, robots_first
from marl_explore.policies.stacking import UnknownLayerError, stack_modules
from marl_explore.transforms.features import FEATURES
from marl_explore.transforms.goals import Candidates
from marl_explore.transforms.memory import CROWDED, GOAL, HEADING, REFUSED, STALLED

ACTION_MASK: NestedKey = ("agents", "action_mask")
PLACE: list[NestedKey] = [("agents", "map"), ("agents", "position")]
ACTION: NestedKey = ("agents", "action")
LOG_PROB: NestedKey = ("agents", "action_log_prob")
CHOICE: NestedKey = ("agents", "choice")
"""Which candidate goal each robot chose, for actors that choose among goals."""
CHOICE_LOG_PROB: NestedKey = ("agents", "choice_log_prob")


class MultiAgentActors(nn.Module):
    """The actors of a team side by side: logits [*B, N, 10] from inputs with a robot axis.

    Args:
        actors: one per robot, or a single one that all robots share.
        groups: the robots of each actor; None: as said above.
    """

    def __init__(
        self, actors: Iterable[nn.Module], groups: Sequence[Sequence[int]] | None = None
    ) -> None:
        super().__init__()
        self.actors = nn.ModuleList(actors)
        several = groups is not None and len(groups) > 1 and any(len(g) > 1 for g in groups)
        self.groups = [torch.tensor(group) for group in groups or ()] if several else []
        # where each robot is in the rows of all groups
        self._places = torch.cat(self.groups).argsort() if self.groups else torch.tensor(())
        self.inputs: tuple[str, ...] = self.actors[0].inputs  # type: ignore[assignment]
        self._together: list[nn.Module] = []  # in a list, so that it is not a submodule

    @contextmanager
    def together(self) -> Iterator[None]:
        """Run all actors as one network in this context, several times faster on small batches.

        Their weights are copied, so they must not change inside. Actors with layers that cannot be
        stacked run one by one.
        """
        if len(self.actors) > 1 and not self.groups:
            with suppress(UnknownLayerError):
                self._together = [stack_modules([*self.actors])]
        try:
            yield
        finally:
            self._together = []

    def forward(self, *inputs: Tensor) -> Tensor:
        """Logits [*B, N, 10]; actor i reads the rows of its robots, a single one reads all."""
        if len(self.actors) == 1:
            return self.actors[0](*inputs)
        if self.groups:
            return self._of_groups(*inputs)
        if self._together:
            logits = self._together[0](*robots_first(self.inputs, *inputs))
            return logits.movedim(0, -2)
        robots = by_robot(self.inputs, *inputs)
        return torch.stack(
            [actor(*robot) for actor, robot in zip(self.actors, robots, strict=True)], -2
        )

    def _of_groups(self, *inputs: Tensor) -> Tensor:
        first = robots_first(self.inputs, *inputs)
        axes = [-1 - FEATURES[name].dims for name in self.inputs]
        rows = [
            actor(*(x[group].movedim(0, axis) for x, axis in zip(first, axes, strict=True)))
            for actor, group in zip(self.actors, self.groups, strict=True)
        ]
        return torch.cat(rows, -2).index_select(-2, self._places.to(rows[0].device))


class TeamActor(TensorDictModuleBase):
    """The policy of a collector: all actors in one module, writing actions and log-probabilities.

    It is equivalent to ``probabilistic_actor(MultiAgentActors(actors))`` in a fraction of the time
    that a chain of modules takes. Actions are sampled;
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` selects the argmax instead.

    Actors that choose among goals write the choice, its log-probability and, into the memory, the
    goal; the action is the first move to it, unless the yield rule (``core.motion.give_way``) says
    otherwise.

    Args:
        actors: as for ``MultiAgentActors``.
        groups: as for ``MultiAgentActors``.
    """

    def __init__(
        self, actors: Iterable[nn.Module], groups: Sequence[Sequence[int]] | None = None
    ) -> None:
        super().__init__()
        self.stacked = MultiAgentActors(actors, groups)
        self.to_goals = chooses_goals(self.stacked.actors[0])
        self.observation_keys = observation_keys(self.stacked.inputs)
        self.in_keys: list[NestedKey] = [*self.observation_keys, ACTION_MASK]
        self.out_keys: list[NestedKey] = [ACTION, LOG_PROB]
        if self.to_goals:
            self.in_keys += [REFUSED, CROWDED, STALLED, HEADING, GOAL, *PLACE]
            self.out_keys = [CHOICE, CHOICE_LOG_PROB, GOAL, ACTION]

    @property
    def _dtype(self) -> torch.dtype:
        """Dtype of the weights: after ``double()`` a policy computes in float64."""
        return next(self.stacked.parameters()).dtype

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write ("agents", "action") int64 [*B, N] and ("agents", "action_log_prob")."""
        inputs = [tensordict.get(key) for key in self.observation_keys]
        logits = self.stacked(*(entry.to(self._dtype) for entry in inputs))
        mask = tensordict.get(ACTION_MASK)
        if not self.to_goals:
            logits = logits.masked_fill(~mask, -torch.inf)
        log_probs = logits.log_softmax(-1)
        likeliest = exploration_type() in (ExplorationType.DETERMINISTIC, ExplorationType.MODE)
        # argmax of p / e with exponential e is distributed as p
        race = log_probs if likeliest else log_probs.exp() / torch.empty_like(logits).exponential_()
        choice = race.argmax(-1)
        choice_key, log_prob_key = choice_keys(self.to_goals)
        tensordict.set(choice_key, choice)
        tensordict.set(log_prob_key, log_probs.gather(-1, choice.unsqueeze(-1)).squeeze(-1))
        if self.to_goals:
            move = follow(tensordict, Candidates(*inputs), choice)
            yields, crowded = tensordict.get(REFUSED), tensordict.get(CROWDED)
            yields = yields | goes_to_and_fro(tensordict, move)
            move = make_room(move, crowded, *(tensordict.get(key) for key in PLACE))
            tensordict.set(ACTION, give_way(move, mask, yields, crowded))
        return tensordict


def chooses_goals(actor: nn.Module) -> bool:
    """Whether an actor chooses among candidate goals, not among actions."""
    return getattr(actor, "chooses", "moves") == "goals"


def choice_keys(to_goals: bool) -> tuple[NestedKey, NestedKey]:
    """The entries of what actors choose and of its log-probability."""
    return (CHOICE, CHOICE_LOG_PROB) if to_goals else (ACTION, LOG_PROB)


def probabilistic_actor(network: nn.Module) -> ProbabilisticTensorDictSequential:
    """A masked categorical policy on the entries of the group "agents".

    With one robot's network it acts on that robot's slice of the group (an actor of HAPPO), with
    ``MultiAgentActors`` on the whole group. Actions are sampled;
    ``set_exploration_type(ExplorationType.DETERMINISTIC)`` selects the argmax instead. Actors that
    choose among goals give the choices that they do not have the probability 0 themselves.
    """
    logits: NestedKey = ("agents", "logits")
    actor = network.actors[0] if isinstance(network, MultiAgentActors) else network
    to_goals = chooses_goals(actor)
    choice, log_prob = choice_keys(to_goals)
    return ProbabilisticActor(
        TensorDictModule(
            network, observation_keys(cast("Sequence[str]", network.inputs)), [logits]
        ),
        in_keys={"logits": logits} if to_goals else {"logits": logits, "mask": ACTION_MASK},
        out_keys=[choice],
        distribution_class=Categorical if to_goals else MaskedCategorical,
        return_log_prob=True,
        log_prob_key=log_prob,
        default_interaction_type=InteractionType.RANDOM,
    )
