"""HAPPO on the exploration task, with the whole loop in one file.

python recipes/minimal_happo.py

Copy this file and change it. It uses the environment, networks and loss of marl_explore and the
collector and advantage estimation of TorchRL; nothing is hidden in a trainer.
"""

from __future__ import annotations

import torch
import tyro
from tensordict import TensorDictBase
from torch.optim import Adam, Optimizer
from torchrl.collectors import Collector
from torchrl.envs import RewardSum

from marl_explore import (
    MLP,
    ArenaConfig,
    HAPPOLoss,
    MultiAgentActors,
    make_env,
    probabilistic_actor,
)

ENVS, STEPS, EPOCHS = 32, 50, 5


def learn(loss: HAPPOLoss, optimizers: dict[str, Optimizer], batch: TensorDictBase) -> None:
    """One update of every actor and of the critic, from a batch [frames] with advantages."""
    for name in loss.update_order():  # one robot after the other ...
        for _ in range(EPOCHS):
            losses = loss.actor_loss(batch, name)
            optimizers[name].zero_grad()
            (losses["loss_objective"] + losses["loss_entropy"]).backward()
            optimizers[name].step()
        loss.update_factor(batch, name)  # ... weighted by the ratios of those before it

    for _ in range(EPOCHS):
        optimizers["critic"].zero_grad()
        loss.critic_loss(batch)["loss_critic"].backward()
        optimizers["critic"].step()


def main(updates: int = 60) -> float:
    """Train a team of four; returns the mean length of the last finished episodes (steps).

    Args:
        updates: number of updates of every network, each on a batch of 32 x 50 steps.
    """
    torch.manual_seed(0)
    arena = ArenaConfig()

    # Arenas side by side: 4 robots, each with its FOV, FPR and NET.
    env = make_env(arena, ENVS, reward="team", terminate_at_coverage=1.0, fpr="proximity")
    env.append_transform(RewardSum())

    # One actor per robot, and one critic that reads all observations.
    names = env.group_map["agents"]
    network = MLP(hidden=(64, 64))
    networks = [network.make_actor(arena) for _ in names]
    critic = network.make_critic(arena, "observation")
    loss = HAPPOLoss(
        actors={n: probabilistic_actor(net) for n, net in zip(names, networks, strict=True)},
        critic=critic,
        group_map=env.group_map,
    )
    loss.make_value_estimator(gamma=0.95, lmbda=0.95)
    optimizers: dict[str, Optimizer] = {
        name: Adam(actor.parameters(), lr=1e-3) for name, actor in loss.actor_losses.items()
    }
    optimizers["critic"] = Adam(critic.parameters(), lr=1e-3)

    # The same networks, stacked, act on whole batches.
    collector = Collector(
        env,
        probabilistic_actor(MultiAgentActors(networks)),
        frames_per_batch=ENVS * STEPS,
        total_frames=ENVS * STEPS * updates,
        auto_register_policy_transforms=False,
    )
    length = float("nan")
    for update, rollout in enumerate(collector, start=1):
        learn(loss, optimizers, loss.estimate_advantage(rollout).reshape(-1))

        ended = rollout["next", "done"].squeeze(-1)
        if ended.any() and update % 10 == 0:
            length = rollout["next", "step_count"][ended].float().mean().item()
            total = rollout["next", "episode_reward"][ended].mean().item()
            print(f"update {update:3d}: return {total:6.2f}, {length:5.1f} steps to a complete map")
    collector.shutdown()
    return length


if __name__ == "__main__":
    tyro.cli(main)
