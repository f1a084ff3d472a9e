"""FPR and NET: the same numbers on an environment, in a replay buffer and alone."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    Categorical,
    Composite,
    LazyTensorStorage,
    TensorDictReplayBuffer,
    Unbounded,
)
from torchrl.envs import Compose, EnvBase, ParallelEnv, SerialEnv, TransformedEnv

from marl_explore import (
    ArenaConfig,
    CommunicationNeighbors,
    ExplorationEnv,
    FrontierReachability,
    make_env,
)
from marl_explore.core.frontier import NORMALIZATIONS
from marl_explore.core.links import within_range
from tests.helpers import oracle

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
                table = torch.tensor(oracle.feature_table(grid, position, "relative"))
                torch.testing.assert_close(step[FPR][robot], table)
            assert torch.equal(step[NET], within_range(step["agents", "position"], 6.4).float())


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
    expected = oracle.feature_table(grid[1, 2, 3].tolist(), position[1, 2, 3].tolist(), None)
    torch.testing.assert_close(td["table"][1, 2, 3], torch.tensor(expected))
    assert td["table"].shape == (2, 3, 4, 8, 3)
    assert torch.equal(td["team", "near"], within_range(position, 2.0).float())


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


def test_the_code_of_the_own_cell_does_not_matter():
    for backend in ("auto", "torch"):
        tables = []
        for code in (-1, 0, 1):
            grid = torch.tensor([[-1, 0, code, 0, -1]], dtype=torch.int8)
            td = TensorDict({"map": grid, "at": torch.tensor([0, 2])}, [])
            tables.append(FrontierReachability("map", "at", "fpr", None, backend)(td)["fpr"])
        assert torch.equal(tables[0], tables[1])
        assert torch.equal(tables[2], tables[1])
        assert tables[1][[2, 6], 0].tolist() == [1, 1]  # a frontier in the east, one in the west


# --------------------------------------------------------------------- bad input

GRID, CELL = torch.zeros(4, 5, dtype=torch.int8), torch.zeros(2, dtype=torch.int64)


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"at": CELL}, "needs the entry 'seen', which is not in the TensorDict; it holds at"),
        ({"seen": TensorDict({"map": GRID}), "at": CELL}, "'seen', which is a group of entries in"),
        (
            {"seen": GRID.float(), "at": CELL},
            "'seen' must be int8 .*free, 1 occ.*got torch.float32",
        ),
        ({"seen": GRID.bool(), "at": CELL}, "'seen' must be int8 .*got torch.bool"),
        (
            {"seen": GRID[0], "at": CELL},
            r"'seen' must be int8 of shape \[\*B, H, W\].*shape \(5,\)",
        ),
        ({"seen": GRID[:0], "at": CELL}, r"'seen' must be int8 of shape .*shape \(0, 5\)"),
        ({"seen": GRID, "at": CELL.float()}, "'at' must be int64 .*got torch.float32"),
        ({"seen": GRID, "at": CELL.int()}, "'at' must be int64 .*got torch.int32"),
        (
            {"seen": GRID.expand(3, 4, 5), "at": CELL.expand(2, 2)},
            r"'at' must be int64 of shape \(3, 2\).*\(2, 2\)",
        ),
        ({"seen": GRID, "at": CELL.to("meta")}, "'at' must be .*on cpu, got .* on meta"),
        ({"seen": GRID, "at": torch.tensor([4, 0])}, r"'at' holds \(4, 0\).*4 x 5"),
        ({"seen": GRID, "at": torch.tensor([0, -1])}, r"'at' holds \(0, -1\).*4 x 5"),
        (
            {"seen": GRID + 100, "at": CELL},
            "'seen' holds 100, which is not a cell value.* -1 unknown, 0 fre",
        ),
        ({"seen": GRID - 2, "at": CELL}, "'seen' holds -2, which is not a cell value"),
    ],
)
def test_entries_of_another_kind_are_named(entries, message):
    with pytest.raises((KeyError, ValueError), match=f"FrontierReachability.*{message}"):
        FrontierReachability("seen", "at", "fpr")(TensorDict(entries, []))


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"cell": CELL}, "needs the entry 'at', which is not in the TensorDict; it holds cell"),
        ({}, "it holds nothing"),
        (
            {"at": CELL},
            r"'at' must be int64 of shape \[\*B, N, 2\].*got torch.int64 of shape \(2,\)",
        ),
        ({"at": CELL.expand(3, 2).float()}, "'at' must be int64 .*got torch.float32"),
        ({"at": CELL.expand(2, 2)[:, :1]}, r"'at' must be int64 .*of shape \(2, 1\)"),
    ],
)
def test_positions_of_another_kind_are_named(entries, message):
    with pytest.raises((KeyError, ValueError), match=f"CommunicationNeighbors.*{message}"):
        CommunicationNeighbors("at", "net")(TensorDict(entries, []))


def test_entries_under_next_are_checked_too():
    step = {"seen": GRID, "at": CELL, "next": {"seen": GRID, "at": torch.tensor([9, 9])}}
    with pytest.raises(ValueError, match=r"'at' holds \(9, 9\)"):
        FrontierReachability("seen", "at", "fpr")(TensorDict(step, []))


def test_an_environment_without_the_entries_is_refused():
    env = TransformedEnv(ExplorationEnv(), FrontierReachability(map_key="map"))
    with pytest.raises(KeyError, match="'map', which is not in the observation spec of the env"):
        _ = env.observation_spec
    with pytest.raises(KeyError, match="'map', which is not in the TensorDict"):
        env.reset()
    env = TransformedEnv(ExplorationEnv(), FrontierReachability(map_key="obstacles"))
    with pytest.raises(ValueError, match="'obstacles' must be int8 .*got torch.bool"):
        env.reset()


class Foreign(EnvBase):
    """One robot in a corridor; its specs say nothing about codes and cells."""

    def __init__(self, code):
        super().__init__()
        self.code = code
        self.observation_spec = Composite(
            map=Unbounded((1, 3), dtype=torch.int8), cell=Unbounded((2,), dtype=torch.int64)
        )
        self.action_spec, self.reward_spec = Categorical(2), Unbounded((1,))

    def _reset(self, tensordict):
        grid = torch.tensor([[0, 0, self.code]], dtype=torch.int8)
        return TensorDict({"map": grid, "cell": torch.zeros(2, dtype=torch.int64)})

    def _step(self, tensordict):
        ends = {"reward": torch.zeros(1), "done": torch.zeros(1, dtype=torch.bool)}
        return self._reset(tensordict).update(ends)

    def _set_seed(self, seed):
        pass


def test_specs_that_do_not_vouch_for_values_have_them_checked():
    feature = FrontierReachability("map", "cell", "fpr", normalize=None)
    env = TransformedEnv(Foreign(code=-1), feature)
    assert env.rollout(2)["fpr"][1, 2].tolist() == [1, 1, 0]
    assert not feature._vouched
    env.base_env.code = 100
    with pytest.raises(ValueError, match="'map' holds 100, which is not a cell value"):
        env.reset()
    own = make_env()
    own.reset()
    assert own.transform[0]._vouched  # its maps are not searched for other codes at every step


def test_settings_that_do_not_exist_are_refused():
    with pytest.raises(ValueError, match="normalize='max' is not one of"):
        FrontierReachability(normalize="max")
    with pytest.raises(ValueError, match="backend='cuda' is not one of"):
        FrontierReachability(backend="cuda")
    for wrong in (-1.0, float("nan"), "6"):
        with pytest.raises(ValueError, match=f"range_cells={wrong!r} is not allowed"):
            CommunicationNeighbors(range_cells=wrong)
    with pytest.raises(ValueError, match="out_key='map' is not allowed"):
        FrontierReachability("map", "cell", "map")
