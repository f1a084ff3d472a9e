"""Another default dtype of torch changes nothing: entries are float32, with the same numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from pettingzoo.test import parallel_api_test
from torchrl.envs import ExplorationType, check_env_specs, set_exploration_type

from marl_explore import (
    FEATURES,
    PLANNERS,
    ArenaConfig,
    ExplorationEnv,
    backend,
    load_policy,
    make_env,
    parallel_env,
)

BACKENDS = ["torch", *(["native"] if backend().startswith("native") else [])]


@pytest.fixture
def _float64():
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def in_both(run):
    """What ``run`` returns with torch's own default dtype and with float64."""
    results = []
    for dtype in (torch.float32, torch.float64):
        torch.set_default_dtype(dtype)
        torch.manual_seed(0)
        try:
            results.append(run())
        finally:
            torch.set_default_dtype(torch.float32)
    return results


def assert_same(one, other):
    """The same entries, dtypes and numbers, up to rounding; no floats but float32."""
    assert set(one.keys(True, True)) == set(other.keys(True, True))
    for key, value in one.items(True, True):
        assert not value.is_floating_point() or value.dtype == torch.float32, key
        torch.testing.assert_close(value, other[key], msg=lambda text, key=key: f"{key}: {text}")


@pytest.mark.parametrize(
    "reward", ["case1", "case2", "case2-lone-idle", "team", "progress", "union"]
)
def test_rollouts_with_every_reward_are_the_same(reward):
    def run():
        env = ExplorationEnv(num_envs=4, reward=reward, terminate_at_coverage=0.9)
        return env.rollout(30, break_when_any_done=False)

    assert_same(*in_both(run))


@pytest.mark.parametrize("fpr", ["relative", "proximity", "absolute", None])
@pytest.mark.parametrize("kernel", BACKENDS)
def test_features_are_the_same(fpr, kernel):
    options = {"fpr": fpr, "backend": kernel, "features": [*FEATURES]}
    assert_same(*in_both(lambda: make_env(num_envs=4, **options).rollout(20)))


@pytest.mark.parametrize("kernel", BACKENDS)
def test_features_and_rewards_of_a_wider_world_are_the_same(kernel):
    config = ArenaConfig(
        sensing_range=(1.5, 2.0, 3.0, 3.0),
        sensing_shape="disc",
        line_of_sight=True,
        wall_loss_db=6.0,
        shadowing_db=4.0,
        message_loss=0.2,
        failure_rate=0.02,
        num_walkers=2,
    )
    options = {"backend": kernel, "features": [*FEATURES], "reward": "union"}
    assert_same(*in_both(lambda: make_env(config, num_envs=4, **options).rollout(20)))


@pytest.mark.usefixtures("_float64")
@pytest.mark.parametrize("kernel", BACKENDS)
def test_the_specs_hold(kernel):
    check_env_specs(ExplorationEnv(num_envs=3))
    check_env_specs(make_env(num_envs=3, features=[*FEATURES], backend=kernel))


@pytest.mark.usefixtures("_float64")
@pytest.mark.parametrize("name", PLANNERS)
def test_planners_act(name):
    td = ExplorationEnv(num_envs=2).rollout(5, PLANNERS[name](ArenaConfig()))
    assert td["agents", "action"].dtype == torch.int64


def test_bundled_policies_act_as_always():
    policy = load_policy("best")

    def run():
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            env = ExplorationEnv(policy.config.arena, num_envs=3)
            return env.rollout(20, load_policy("best"))

    one, other = in_both(run)
    assert torch.equal(one["agents", "action"], other["agents", "action"])


def test_pettingzoo_gives_float32():
    def run():
        env = parallel_env(render_mode="rgb_array")
        observations, _ = env.reset(seed=3)
        parallel_api_test(env, 20)
        numbers = observations["robot_0"]["observation"]
        assert env.observation_space("robot_0").contains(observations["robot_0"])
        assert env.state().dtype == np.float32
        return numbers

    one, other = in_both(run)
    assert one.dtype == other.dtype == np.float32
    assert np.array_equal(one, other)
