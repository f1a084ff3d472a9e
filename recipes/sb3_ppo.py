"""Stable-Baselines3's PPO on the PettingZoo environment, vectorised over robots by SuperSuit.

python recipes/sb3_ppo.py

For PPO every robot of every arena is an environment, and all share one policy. The action mask is
part of the observation, since Stable-Baselines3 does not mask actions. Needs the extra "sb3"
(``pip install ".[sb3]"``).
"""

from __future__ import annotations

import sys
import warnings
from typing import Any

import tyro

try:
    from stable_baselines3 import PPO
    from stable_baselines3.common.utils import set_random_seed
    from stable_baselines3.common.vec_env import VecMonitor
    from supersuit import concat_vec_envs_v1, pettingzoo_env_to_vec_env_v1
except ModuleNotFoundError as error:
    sys.exit(f'error: this program needs {error.name}: pip install "marl-explore[sb3]"')

from marl_explore import ArenaConfig, parallel_env, require_integer, run_program

ARENAS, STEPS = 8, 25


def vectorized_env(seed: int = 0) -> VecMonitor:
    """Robots of 8 arenas as one vector of environments, with their returns in the infos."""
    arena = ArenaConfig(height=6, width=6, num_agents=3, communication_range=2.0)
    env = parallel_env(arena, "team", STEPS, fpr="proximity")
    robots = pettingzoo_env_to_vec_env_v1(env)
    vector = concat_vec_envs_v1(robots, ARENAS, base_class="stable_baselines3")
    vector.venv.reset(seed=seed)  # the copies of the environment get seed, seed + 1, ...
    with warnings.catch_warnings():  # SuperSuit's vector environment lacks it
        warnings.filterwarnings("ignore", "The `render_mode` attribute is not defined")
        return VecMonitor(vector)


def mean_return(model: PPO, episodes: int = 10, seed: int = 1_000_000) -> float:
    """Mean return with sampled actions over some episodes of each robot, in unseen arenas."""
    env = vectorized_env(seed)
    observation: Any = env.reset()
    returns: list[float] = []
    while len(returns) < episodes * env.num_envs:
        action, _ = model.predict(observation)
        observation, _, _, infos = env.step(action)
        returns += [info["episode"]["r"] for info in infos if "episode" in info]
    return sum(returns) / len(returns)


def main(steps: int = 60_000, seed: int = 0) -> tuple[float, float]:
    """Train a shared policy; returns the mean return before and after.

    Args:
        steps: number of steps, counted for every robot.
        seed: of arenas, network and actions.
    """
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    set_random_seed(seed)  # PPO's own argument would also seed the environment, which fails
    model = PPO(
        "MultiInputPolicy",
        vectorized_env(seed),
        n_steps=2 * STEPS,
        batch_size=300,
        gamma=0.95,
        ent_coef=0.01,
        device="cpu",
    )
    before = mean_return(model)
    model.learn(steps)
    after = mean_return(model)
    print(f"mean return: {before:.2f} before, {after:.2f} after {model.num_timesteps} steps")
    return before, after


if __name__ == "__main__":
    run_program(lambda: tyro.cli(main), lambda _: None)
