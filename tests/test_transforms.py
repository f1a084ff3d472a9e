"""FPR and NET: the same numbers on an environment, in a replay buffer and alone."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import Compose, ParallelEnv, SerialEnv, TransformedEnv

from marl_explore import (
    ArenaConfig,
    CommunicationNeighbors,
    ExplorationEnv,
    FrontierReachability,
    make_env,
)
from marl_explore.core.frontier import NORMALIZATIONS
from marl_explore.core.radio import in_range
from tests import reference

FPR, NET = ("agents", "observation", "fpr"), ("agents", "observation", "net")
FEATURES = [FPR, NET, ("next", *FPR), ("next", *NET)]


def features(normalize="relative"):
    return Compose(FrontierReachability(normalize=normalize), CommunicationNeighbors())


def staggered_rollout(normalize="relative", steps=25):
    """Arenas that end at different times: 8 arenas that stop when half is covered."""
    env = make_env(
        ArenaConfig(height=6, width=7, num_agents=3),
        num_envs=8,
        terminate_at_coverage=0.7,
        max_steps=11,
        fpr=normalize,
    )
    return env.rollout(steps, break_when_any_done=False)


def test_resets_are_staggered():
    ends = staggered_rollout()["next", "done"].squeeze(-1)
    assert 0 < ends.any(0).sum() < ends.shape[1]
    assert any(0 < column.sum() < 8 for column in ends.T)


@pytest.mark.parametrize("normalize", NORMALIZATIONS)
def test_features_online_equal_features_offline(normalize):
    online = staggered_rollout(normalize)
    offline = features(normalize)(online.exclude(*FEATURES).clone())
    for key in FEATURES:
        assert torch.equal(online[key], offline[key]), key


def test_features_equal_the_slow_reference():
    rollout = staggered_rollout(steps=12)
    for episode in rollout[:3]:
        for step in episode:
            for robot in range(3):
                grid = step["agents", "map"][robot].tolist()
                position = tuple(step["agents", "position"][robot].tolist())
                table = torch.tensor(reference.feature_table(grid, position, "relative"))
                torch.testing.assert_close(step[FPR][robot], table)
            assert torch.equal(step[NET], in_range(step["agents", "position"], 6.4).float())


def test_features_in_a_replay_buffer():
    online = staggered_rollout().reshape(-1)
    online["row"] = torch.arange(len(online))
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(online)), batch_size=32, transform=features()
    )
    buffer.extend(online.exclude(*FEATURES))
    sample = buffer.sample()
    for key in FEATURES:
        assert torch.equal(sample[key], online[sample["row"]][key])


def test_features_alone_with_any_keys_and_batch_dims():
    grid = torch.randint(-1, 2, (2, 3, 4, 5, 6), dtype=torch.int8)
    position = torch.stack((torch.randint(0, 5, (2, 3, 4)), torch.randint(0, 6, (2, 3, 4))), -1)
    td = TensorDict({"team": {"seen": grid, "at": position}}, batch_size=[2])
    FrontierReachability(("team", "seen"), ("team", "at"), "table", normalize=None)(td)
    CommunicationNeighbors(("team", "at"), ("team", "near"), range_cells=2.0)(td)
    expected = reference.feature_table(grid[1, 2, 3].tolist(), position[1, 2, 3].tolist(), None)
    torch.testing.assert_close(td["table"][1, 2, 3], torch.tensor(expected))
    assert td["table"].shape == (2, 3, 4, 8, 3)
    assert torch.equal(td["team", "near"], in_range(position, 2.0).float())


def test_features_of_one_robot():
    td = TensorDict(
        {"map": torch.zeros(5, 5, dtype=torch.int8), "position": torch.tensor([2, 2])}, []
    )
    FrontierReachability("map", "position", "fpr")(td)
    assert (td["fpr"] == 0).all()  # everything is known: no frontier


def test_unlimited_range_sees_everyone():
    td = TensorDict({"at": torch.tensor([[0, 0], [90, 90]])}, [])
    assert CommunicationNeighbors("at", "net", range_cells=float("inf"))(td)["net"].all()


@pytest.mark.parametrize("batched", [SerialEnv, ParallelEnv])
def test_features_in_batched_environments(batched):
    make = partial(make_env, ArenaConfig(height=6, width=6), num_envs=2, max_steps=4)
    env = batched(2, [partial(make, first_arena=0), partial(make, first_arena=2)])
    try:
        td = env.reset()
        single = make(num_envs=4).reset()
        assert torch.equal(td.flatten(0, 1)[FPR], single[FPR])
        rollout = env.rollout(9, break_when_any_done=False)
        offline = features()(rollout.exclude(*FEATURES).clone())
        for key in FEATURES:
            assert torch.equal(rollout[key], offline[key]), key
    finally:
        env.close()


def test_transforms_append_to_a_bare_environment():
    env = TransformedEnv(ExplorationEnv(num_envs=2), FrontierReachability())
    assert FPR in env.reset().keys(True)
    assert env.observation_spec[FPR].shape == (2, 4, 8, 3)


# --------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"at": torch.zeros(2, dtype=torch.int64)}, "needs the entry 'seen'.*it holds at"),
        (
            {"seen": torch.zeros(4, 4), "at": torch.zeros(2, dtype=torch.int64)},
            "'seen' must be int8 .*got torch.float32",
        ),
        (
            {"seen": torch.zeros(4, 4, dtype=torch.int8), "at": torch.zeros(2)},
            "'at' must be int64 .*got torch.float32",
        ),
        (
            {"seen": torch.zeros(3, 4, 4, dtype=torch.int8), "at": torch.zeros(2, 2).long()},
            r"'at' must be int64 of shape \(3, 2\).*\(2, 2\)",
        ),
        (
            {"seen": torch.zeros(4, 4, dtype=torch.int8), "at": torch.tensor([4, 0])},
            r"'at' .*\(4, 0\).*4 x 4",
        ),
    ],
)
def test_entries_of_another_kind_are_named(entries, message):
    with pytest.raises((KeyError, ValueError), match=message):
        FrontierReachability("seen", "at", "fpr")(TensorDict(entries, []))


def test_settings_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="normalize='max' is not one of"):
        FrontierReachability(normalize="max")
    with pytest.raises(ValueError, match="backend='cuda' is not one of"):
        FrontierReachability(backend="cuda")
    with pytest.raises(ValueError, match="range_cells=-1.0 is not allowed"):
        CommunicationNeighbors(range_cells=-1.0)
