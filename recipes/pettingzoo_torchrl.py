"""MAPPO from TorchRL's own parts on the PettingZoo environment, with TorchRL's wrapper.

python recipes/pettingzoo_torchrl.py

Copy this file and change it: only the wrapped environment uses marl_explore. It steps one arena at
a time; use ``marl_explore.make_env`` to train on many.
"""

from __future__ import annotations

import warnings

import torch
import tyro
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.collectors import Collector
from torchrl.envs import PettingZooWrapper
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MaskedCategorical, MultiAgentMLP, ProbabilisticActor
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from marl_explore import ArenaConfig, parallel_env, require_integer, run_program

EPISODES, STEPS, EPOCHS = 12, 25, 10
GROUP = "agents"
OBSERVATION = (GROUP, "observation", "observation")


def wrapped_env(arena: ArenaConfig, seed: int = 0) -> PettingZooWrapper:
    """The environment in TorchRL: all robots in one group, with action masks."""
    env = parallel_env(arena, "team", STEPS, seed=seed, fpr="proximity")
    with warnings.catch_warnings():  # about the version that it was tested with
        warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested")
        return PettingZooWrapper(env, group_map={GROUP: env.possible_agents})


def make_loss(env: PettingZooWrapper) -> ClipPPOLoss:
    """One actor for all robots, and a critic that reads all observations."""
    *_, robots, features = env.observation_spec[OBSERVATION].shape
    actions = env.full_action_spec[GROUP, "action"].space.n

    def network(outputs: int, *, centralized: bool) -> MultiAgentMLP:
        return MultiAgentMLP(
            n_agent_inputs=features,
            n_agent_outputs=outputs,
            n_agents=robots,
            centralized=centralized,
            share_params=True,
            num_cells=(64, 64),
            activation_class=nn.Tanh,
        )

    action, mask, logits = ((GROUP, key) for key in ("action", "action_mask", "logits"))
    policy = ProbabilisticActor(
        TensorDictModule(network(actions, centralized=False), [OBSERVATION], [logits]),
        in_keys={"logits": logits, "mask": mask},
        out_keys=[action],
        distribution_class=MaskedCategorical,
        return_log_prob=True,
        log_prob_key=(GROUP, "log_prob"),
    )
    critic = TensorDictModule(network(1, centralized=True), [OBSERVATION], [(GROUP, "state_value")])
    loss = ClipPPOLoss(policy, critic, entropy_coeff=0.01)
    loss.set_keys(
        action=action,
        sample_log_prob=(GROUP, "log_prob"),
        value=(GROUP, "state_value"),
        **{key: (GROUP, key) for key in ("reward", "done", "terminated")},
    )
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.95, lmbda=0.95, average_gae=True)
    return loss


def main(updates: int = 40, seed: int = 0) -> list[float]:
    """Train three robots on 6 x 6 cells; returns the mean episode return of every update.

    Args:
        updates: number of updates, each on 12 episodes of 25 steps.
        seed: of arenas, networks and actions.
    """
    require_integer("updates", updates, 1)
    require_integer("seed", seed, 0)
    torch.manual_seed(seed)
    env = wrapped_env(ArenaConfig(height=6, width=6, num_agents=3, communication_range=2.0), seed)
    check_env_specs(env)
    loss = make_loss(env)
    optimizer = torch.optim.Adam(loss.parameters(), lr=5e-3)
    frames = EPISODES * STEPS
    collector = Collector(
        env,
        loss.actor_network,
        frames_per_batch=frames,
        total_frames=frames * updates,
        auto_register_policy_transforms=False,
    )
    returns = []
    for rollout in collector:
        with torch.no_grad():
            loss.value_estimator(rollout)
        for _ in range(EPOCHS):
            losses = loss(rollout)
            optimizer.zero_grad()
            sum(losses[f"loss_{part}"] for part in ("objective", "entropy", "critic")).backward()
            optimizer.step()
        reward = rollout["next", GROUP, "reward"]  # the same for all robots
        returns.append(reward.sum().item() / len(env.group_map[GROUP]) / EPISODES)
        if len(returns) % 10 == 0:
            print(f"update {len(returns):3d}: return {returns[-1]:6.2f}")
    collector.shutdown()
    return returns


if __name__ == "__main__":
    run_program(lambda: tyro.cli(main), lambda _: None)
