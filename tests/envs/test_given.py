"""What callers hand to the environment: wrong actions and seeds are named, and change nothing."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector

from marl_explore import ExplorationEnv, make_env

ACTION = ("agents", "action")
makers = pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "make_env"])


def actions(value, dtype=torch.int64):
    """All robots stay, except robot 1 in arena 1."""
    action = torch.full((2, 4), 8, dtype=dtype)
    action[1, 1] = value
    return action


WRONG = {
    "12": (actions(12), r"=12 of robot 1 in arena 1 is not allowed: .* integer from 0 to 9"),
    "10": (actions(10), r"=10 of robot 1 in arena 1 is not allowed"),
    "-1": (actions(-1), r"=-1 of robot 1 in arena 1 is not allowed"),
    "2**40": (actions(2**40), rf"={2**40} of robot 1 in arena 1 is not allowed"),
    "2.5": (torch.full((2, 4), 2.5), r" must be torch.int64 .* 0 to 9, got torch.float32.* 2.5"),
    "2.0": (torch.full((2, 4), 2.0), r" must be torch.int64 .* got torch.float32 .* 2.0"),
    "nan": (torch.full((2, 4), torch.nan), r" must be torch.int64 .* got torch.float32 .* nan"),
    "bool": (torch.ones(2, 4, dtype=torch.bool), r" must be torch.int64 .* got torch.bool .*True"),
    "a robot less": (torch.zeros(2, 3, dtype=torch.int64), r" must be .* \(2, 4\), .* \(2, 3\)"),
    "an axis more": (
        torch.zeros(2, 4, 1, dtype=torch.int64),
        r" must be .* \(2, 4\), .* \(2, 4, 1\)",
    ),
    "one-hot": (torch.zeros(2, 4, 10, dtype=torch.bool), r" must be .* \(2, 4\), .* \(2, 4, 10\)"),
    "none": (None, " is missing: .* integer from 0 to 9"),
}


@makers
@pytest.mark.parametrize(("action", "message"), WRONG.values(), ids=WRONG)
def test_wrong_actions_are_named_and_change_nothing(make, action, message):
    env, other = make(num_envs=2), make(num_envs=2)
    td, expected = env.reset(), other.reset()
    wrong = td.clone()
    if action is not None:
        wrong["agents"].batch_size = [2]
        wrong[ACTION] = action
    with pytest.raises(ValueError, match=r"\('agents', 'action'\)" + message):
        env.step(wrong)
    stay = torch.full((2, 4), 8)
    after, expected = env.step(td.set(ACTION, stay)), other.step(expected.set(ACTION, stay))
    assert (after == expected).all()


@pytest.mark.parametrize("dtype", [torch.int32, torch.int16, torch.int8, torch.uint8])
def test_narrower_integers_are_actions(dtype):
    env, other = ExplorationEnv(num_envs=2), ExplorationEnv(num_envs=2)
    one = env.step(env.reset().set(ACTION, actions(3, dtype)))["next"]
    two = other.step(other.reset().set(ACTION, actions(3)))["next"]
    assert (one == two).all()


def test_a_policy_of_wrong_actions_in_a_collector_is_told_so():
    def policy(td):
        return td.set(ACTION, torch.full((2, 4), 12))

    options = {"frames_per_batch": 10, "auto_register_policy_transforms": False}
    collector = Collector(make_env(num_envs=2), policy, **options)
    with pytest.raises(ValueError, match=r"\('agents', 'action'\)=12 of robot 0 in arena 0"):
        next(iter(collector))
    collector.shutdown(raise_on_error=False)


GOOD_SEEDS = [5, np.int64(5), np.uint8(5), np.array([5]), np.array(5), torch.tensor(5)]
BAD_SEEDS = [-1, 1.5, np.float64(5), "x", "5", True, 2**64, 2**70, np.array([1, 2]), [], {}]


@makers
@pytest.mark.parametrize("seed", GOOD_SEEDS, ids=repr)
def test_seeds_may_be_integers_of_any_library(make, seed):
    expected = make(seed=5).reset()["obstacles"]
    env = make(seed=seed)
    assert torch.equal(env.reset()["obstacles"], expected)
    second = env.reset()["obstacles"]
    env.base_env._set_seed(seed) if make is make_env else env._set_seed(seed)
    assert torch.equal(env.reset()["obstacles"], expected)
    assert torch.equal(env.reset()["obstacles"], second)


@makers
@pytest.mark.parametrize("seed", BAD_SEEDS, ids=repr)
def test_other_seeds_are_refused_and_change_nothing(make, seed):
    allowed = r"is not allowed: it must be an integer of at least 0 and below 2\*\*64"
    with pytest.raises(ValueError, match=rf"seed=.* {allowed}"):
        make(seed=seed)
    env, other = make(seed=3), make(seed=3)
    env.reset(), other.reset()
    with pytest.raises(ValueError, match=rf"seed=.* {allowed}"):
        env.set_seed(seed)
    assert (env.reset() == other.reset()).all()


def test_large_seeds_differ():
    drawn = [ExplorationEnv(seed=seed).reset()["obstacles"] for seed in (0, 1, 2**63, 2**64 - 1)]
    assert len({tuple(obstacles.flatten().tolist()) for obstacles in drawn}) == 4
