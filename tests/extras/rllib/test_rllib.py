"""RLlib's PPO on the PettingZoo environment: it runs, and no robot does what is forbidden."""

from __future__ import annotations

import subprocess
import sys

import pytest
from ray.rllib.env import multi_agent_env_runner
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.rllib.utils.pre_checks.env import check_multiagent_environments

from marl_explore import parallel_env
from recipes import rllib_ppo as recipe


class Watch:
    """Counts the robots' actions, and those that their masks forbid."""

    def __init__(self):
        self.actions = self.forbidden = 0

    def __call__(self, *settings, **options):
        env, watch = parallel_env(*settings, **options), self
        step = env.step

        def watched(actions):
            masks = env._masks()
            watch.actions += len(actions)
            watch.forbidden += sum(not masks[agent][action] for agent, action in actions.items())
            return step(actions)

        env.step = watched
        return env


@pytest.fixture
def watch(monkeypatch):
    watch = Watch()
    monkeypatch.setattr(recipe, "parallel_env", watch)
    # it takes a random action, whatever the mask says; below it is tested apart
    monkeypatch.setattr(multi_agent_env_runner, "check_multiagent_environments", lambda env: None)
    return watch


def test_the_recipe_takes_allowed_actions_only(watch):
    returns = recipe.main(iterations=2)
    assert len(returns) == 2
    assert all(-25 < value < 5 for value in returns)
    assert watch.actions >= 2 * recipe.BATCH * 3
    assert watch.forbidden == 0


def test_the_watch_sees_forbidden_actions(watch):
    env = watch(max_steps=30)
    env.reset(seed=0)
    while env.agents:
        env.step(dict.fromkeys(env.agents, 0))
    assert watch.forbidden > 0


def test_rllib_accepts_the_environment():
    env = ParallelPettingZooEnv(parallel_env(max_steps=5))
    check_multiagent_environments(env)
    observations, _ = env.reset(seed=3)
    ends = {"__all__": False}
    while not ends["__all__"]:
        actions = {
            agent: env.action_space[agent].sample(seen["action_mask"])
            for agent, seen in observations.items()
        }
        observations, _, _, ends, _ = env.step(actions)
    assert set(ends) == {*env.possible_agents, "__all__"}


def test_help():
    command = [sys.executable, recipe.__file__, "--help"]
    assert "usage:" in subprocess.run(command, capture_output=True, text=True, check=True).stdout
