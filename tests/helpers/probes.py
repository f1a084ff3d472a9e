"""Tiny team tasks with known optimal values: when one fails, it says which part of a learner broke.

All are TorchRL environments of one form: two robots of the group "agents" see the same state,
one-hot, and share one reward at the root. Each has three actions; the mask forbids the last.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

ROBOTS = 2
ACTIONS = 3
FORBIDDEN = 2


class Probe(EnvBase):
    """A Markov game of a few states; subclasses define its start and its outcomes.

    ============================ =================== ======= ======================================
    Entry                        Shape               Type    Meaning
    ============================ =================== ======= ======================================
    state                        [B]                 int64   number of the state
    (agents, observation)        [B, 2, num_states]  float32 the state, one-hot
    (agents, action_mask)        [B, 2, 3]           bool    True, True, False
    (agents, action)             [B, 2]              int64
    reward, done, terminated,    [B, 1]                      of the team
    truncated
    ============================ =================== ======= ======================================
    """

    num_states = 1
    horizon = 1
    """Steps after which all episodes are over."""

    def __init__(self, num_envs: int = 64, seed: int = 0) -> None:
        super().__init__(batch_size=[num_envs])
        self.generator = torch.Generator()
        self.set_seed(seed)
        team = (num_envs, ROBOTS)
        self.observation_spec = Composite(
            state=Categorical(self.num_states, shape=(num_envs,)),
            agents=Composite(
                observation=Unbounded((*team, self.num_states)),
                action_mask=Binary(shape=(*team, ACTIONS), dtype=torch.bool),
                shape=team,
            ),
            shape=(num_envs,),
        )
        self.action_spec = Composite(
            agents=Composite(action=Categorical(ACTIONS, shape=team), shape=team),
            shape=(num_envs,),
        )
        self.reward_spec = Unbounded((num_envs, 1))
        flag = Binary(shape=(num_envs, 1), dtype=torch.bool)
        self.done_spec = Composite(
            done=flag, terminated=flag.clone(), truncated=flag.clone(), shape=(num_envs,)
        )

    def start(self) -> Tensor:
        """First states [B]."""
        return torch.zeros(self.batch_size, dtype=torch.int64)

    def outcome(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Next state [B], reward [B] and termination [B] from states [B] and actions [B, 2]."""
        raise NotImplementedError

    def _observe(self, state: Tensor) -> dict[str, Tensor | TensorDict]:
        observation = torch.nn.functional.one_hot(state, self.num_states).float()
        mask = torch.ones(*self.batch_size, ROBOTS, ACTIONS, dtype=torch.bool)
        mask[..., FORBIDDEN] = False
        agents = {
            "observation": observation.unsqueeze(-2).repeat(1, ROBOTS, 1),
            "action_mask": mask,
        }
        return {"state": state, "agents": TensorDict(agents, (*self.batch_size, ROBOTS))}

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDict:
        running = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        flags = {key: running.clone() for key in ("done", "terminated", "truncated")}
        return TensorDict({**self._observe(self.start()), **flags}, self.batch_size)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["agents", "action"]
        assert (action != FORBIDDEN).all(), "a robot took an action its mask forbids"
        state, reward, terminated = self.outcome(tensordict["state"], action)
        truncated = self._truncated(tensordict["state"])
        ends = {"terminated": terminated, "truncated": truncated, "done": terminated | truncated}
        flags = {key: value.unsqueeze(-1) for key, value in ends.items()}
        entries = {**self._observe(state), **flags, "reward": reward.float().unsqueeze(-1)}
        return TensorDict(entries, self.batch_size)

    def _truncated(self, state: Tensor) -> Tensor:
        return torch.zeros_like(state, dtype=torch.bool)

    def _set_seed(self, seed: int | None) -> None:
        if seed is not None:
            self.generator.manual_seed(seed)


class ConstantReward(Probe):
    """One step, reward 1 whatever they do. V = 1."""

    def outcome(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        reward = torch.ones_like(state)
        return state, reward, reward.bool()


class DelayedReward(Probe):
    """Two steps. State 0 leads to 1 if both robots choose action 1, else to 2; 1 pays 1, 2 pays 0.

    Optimal values: V(0) = gamma, V(1) = 1, V(2) = 0.
    """

    num_states = 3
    horizon = 2

    def outcome(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        first = state == 0
        after_first = torch.where((action == 1).all(-1), 1, 2)
        return torch.where(first, after_first, state), state == 1, ~first


class ObservedReward(Probe):
    """One step from state 0 or 1. Per robot whose action is the state: a reward of (state + 1) / 2.

    Optimal values: V(0) = 1, V(1) = 2.
    """

    num_states = 2

    def start(self) -> Tensor:
        return torch.randint(2, self.batch_size, generator=self.generator)

    def outcome(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        right = (action == state.unsqueeze(-1)).float().mean(-1)
        return state, right * (state + 1), torch.ones_like(state, dtype=torch.bool)


class CutOff(Probe):
    """Reward 1 at every step of a task without end, cut off (truncated) after two steps.

    V = 1 / (1 - gamma) in both states, but 1 in the second for a learner that takes the cut for an
    end.
    """

    num_states = 2
    horizon = 2

    def outcome(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return 1 - state, torch.ones_like(state), torch.zeros_like(state, dtype=torch.bool)

    def _truncated(self, state: Tensor) -> Tensor:
        return state == 1


class Coordination(Probe):
    """One step; exactly one robot should choose action 1 (Kuba et al., ICLR 2022, HATRPO).

    Rewards: nobody 0, one of the two 2, both -1. As long as the other one chooses 1 with less than
    probability 0.4, each robot alone does better by choosing it more often, and both together
    overshoot. V = 2, reached at (0, 1) and (1, 0).
    """

    payoff = torch.tensor([[0.0, 2.0], [2.0, -1.0]])

    def outcome(self, state: Tensor, action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        reward = self.payoff[action[..., 0], action[..., 1]]
        return state, reward, torch.ones_like(state, dtype=torch.bool)
