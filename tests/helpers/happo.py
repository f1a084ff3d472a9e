"""Teams, batches and brute-force formulas to hold HAPPO's loss against."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import InteractionType, NormalParamExtractor, TensorDictModule
from torch import Tensor, nn
from torch.distributions import Normal, TanhTransform, TransformedDistribution
from torchrl.modules import (
    MaskedCategorical,
    ProbabilisticActor,
    TanhNormal,
)

from marl_explore.happo.loss import HAPPOLoss

ARENAS, STEPS, ROBOTS = 6, 11, 4
FEATURES, ACTIONS = 5, 4
DRONE_FEATURES, DRONE_ACTIONS = 3, 2
CLIP = 0.2
GAMMA, LMBDA = 0.9, 0.8
NAMES = [f"robot_{i}" for i in range(ROBOTS)]
VIEWS = {name: ("agents", i) for i, name in enumerate(NAMES)}


# ------------------------------------------------------------------------ networks


def mlp(inputs: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 16), nn.Tanh(), nn.Linear(16, outputs))


def ground_network() -> nn.Module:
    """Logits of a ground robot."""
    return mlp(FEATURES, ACTIONS)


def drone_network() -> nn.Module:
    """Location and scale of a drone's continuous action."""
    return nn.Sequential(mlp(DRONE_FEATURES, 2 * DRONE_ACTIONS), NormalParamExtractor())


def masked_actor(network: nn.Module, group: str) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(network, [(group, "observation")], [(group, "logits")]),
        in_keys={"logits": (group, "logits"), "mask": (group, "action_mask")},
        out_keys=[(group, "action")],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=(group, "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
    )


def continuous_actor(network: nn.Module, group: str) -> ProbabilisticActor:
    return ProbabilisticActor(
        TensorDictModule(network, [(group, "observation")], [(group, "loc"), (group, "scale")]),
        in_keys={"loc": (group, "loc"), "scale": (group, "scale")},
        out_keys=[(group, "action")],
        distribution_class=TanhNormal,
        return_log_prob=True,
        log_prob_key=(group, "action_log_prob"),
        default_interaction_type=InteractionType.RANDOM,
    )


def state_critic(value_key: str = "state_value") -> TensorDictModule:
    return TensorDictModule(mlp(FEATURES, 1), ["state"], [value_key])


def parameters_of(*modules: nn.Module) -> list[Tensor]:
    return [p.detach().clone() for module in modules for p in module.parameters()]


def all_equal(first: Iterable[Tensor], second: Iterable[Tensor]) -> bool:
    return all(torch.equal(a, b) for a, b in zip(first, second, strict=True))


def perturb(network: nn.Module, size: float = 0.3) -> None:
    """An update of unknown origin."""
    with torch.no_grad():
        for parameter in network.parameters():
            parameter += size * torch.randn_like(parameter)


def total(losses: TensorDictBase) -> Tensor:
    return sum(value for key, value in losses.items() if key.startswith("loss_"))


def descend(optimizer: torch.optim.Optimizer, losses: TensorDictBase) -> None:
    optimizer.zero_grad()
    total(losses).backward()
    optimizer.step()


def assert_same_losses(first: TensorDictBase, second: TensorDictBase) -> None:
    assert set(first.keys()) == set(second.keys())
    for key, value in first.items():
        assert torch.equal(value, second[key]), key


# ------------------------------------------------------------------------- batches


def random_mask(*shape: int) -> Tensor:
    mask = torch.rand(*shape, ACTIONS) < 0.6
    mask[..., 0] = True
    return mask


def rollout(**entries: Tensor | dict[str, Tensor]) -> TensorDict:
    """A batch [6, 11] of these entries, random states, rewards and ends of episodes."""
    shape = (ARENAS, STEPS)
    terminated = torch.rand(*shape, 1) < 0.1
    truncated = torch.rand(*shape, 1) < 0.1
    after = {
        "state": torch.randn(*shape, FEATURES),
        "reward": torch.randn(*shape, 1),
        "done": terminated | truncated,
        "terminated": terminated,
    }
    entries = {"state": torch.randn(*shape, FEATURES), **entries, "next": after}
    return TensorDict(entries, shape)


def with_advantage(batch: TensorDict) -> TensorDict:
    batch["advantage"] = torch.randn(*batch.shape, 1)
    batch["value_target"] = torch.randn(*batch.shape, 1)
    return batch


# ------------------------------------------------------------- brute-force formulas


def masked_log_prob(
    network: nn.Module, observation: Tensor, mask: Tensor, action: Tensor
) -> Tensor:
    logits = network(observation).masked_fill(~mask, -torch.inf)
    return logits.log_softmax(-1).gather(-1, action.unsqueeze(-1)).squeeze(-1)


def tanh_normal_log_prob(network: nn.Module, observation: Tensor, action: Tensor) -> Tensor:
    loc, scale = network(observation)
    return TransformedDistribution(Normal(loc, scale), TanhTransform()).log_prob(action).sum(-1)


def robot_ratio(new: nn.Module, old: nn.Module, batch: TensorDictBase, robot: int) -> Tensor:
    """Ratio [*B] of a robot's new to its old policy, its row of the group "agents" being given."""
    keys = ("observation", "action_mask", "action")
    row = [batch["agents", key].select(batch.ndim, robot) for key in keys]
    return (masked_log_prob(new, *row) - masked_log_prob(old, *row).detach()).exp()


def clipped_objective(ratio: Tensor, factor: Tensor, advantage: Tensor) -> Tensor:
    """The loss as the HAPPO paper has it, factor outside: -E[M min(r A, clip(r) A)]."""
    clipped = ratio.clamp(1 - CLIP, 1 + CLIP)
    return -(factor * torch.min(ratio * advantage, clipped * advantage)).mean()


def gae_by_hand(
    values: list[float],
    next_values: list[float],
    rewards: list[float],
    dones: list[bool],
    terminations: list[bool],
) -> list[float]:
    """Advantages of one row of steps, some of which end an episode."""
    advantages = [0.0] * len(rewards)
    following = 0.0
    for t in reversed(range(len(rewards))):
        bootstrap = 0.0 if terminations[t] else next_values[t]
        error = rewards[t] + GAMMA * bootstrap - values[t]
        following = error + (0.0 if dones[t] else GAMMA * LMBDA * following)
        advantages[t] = following
    return advantages


# ---------------------------------------------------- four robots of a stacked group


@dataclass
class Team:
    """Four robots with views of the group "agents", a critic of the joint observation, a batch."""

    networks: list[nn.Module]
    critic: TensorDictModule
    loss: HAPPOLoss
    batch: TensorDict  # [6, 11], with random advantages and value targets

    @property
    def modules(self) -> list[nn.Module]:
        return [*self.networks, self.critic]


def make_team(value_key: str = "state_value", **options) -> Team:
    networks = [ground_network() for _ in NAMES]
    critic = TensorDictModule(
        nn.Sequential(nn.Flatten(-2), mlp(ROBOTS * FEATURES, 1)),
        [("agents", "observation")],
        [value_key],
    )
    actors = {n: masked_actor(net, "agents") for n, net in zip(NAMES, networks, strict=True)}
    loss = HAPPOLoss(actors, critic, views=VIEWS, clip_epsilon=CLIP, **options)

    shape = (ARENAS, STEPS, ROBOTS)
    observation, mask = torch.randn(*shape, FEATURES), random_mask(*shape)
    rows = zip(networks, observation.unbind(-2), strict=True)
    with torch.no_grad():
        logits = torch.stack([network(own) for network, own in rows], -2)
    policy = torch.distributions.Categorical(logits=logits.masked_fill(~mask, -torch.inf))
    action = policy.sample()
    agents = {
        "observation": observation,
        "action_mask": mask,
        "action": action,
        "action_log_prob": policy.log_prob(action),
    }
    batch = with_advantage(rollout(agents=agents))
    batch["next", "agents"] = {"observation": torch.randn(*shape, FEATURES)}
    return Team(networks, critic, loss, batch)


def episodes() -> TensorDict:
    """Two rows of eight steps. Row 0: terminated at 2, truncated at 5. Row 1: both the other way.

    Next observations continue within an episode; where one ends, they differ from the first
    observation of the next episode. Both rows go on at the end of the batch.
    """
    rows, steps = 2, 8
    terminated = torch.zeros(rows, steps, 1, dtype=torch.bool)
    truncated = torch.zeros_like(terminated)
    terminated[0, 2] = truncated[0, 5] = truncated[1, 3] = terminated[1, 6] = True
    done = terminated | truncated
    state = torch.randn(rows, steps, FEATURES)
    following = torch.cat([state[:, 1:], torch.randn(rows, 1, FEATURES)], 1)
    after = {
        "state": torch.where(done, torch.randn_like(following), following),
        "reward": torch.randn(rows, steps, 1),
        "done": done,
        "terminated": terminated,
    }
    return TensorDict({"state": state, "next": after}, [rows, steps])
