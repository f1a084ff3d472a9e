"""The wider world against its slow oracle: sight, radio, mixed teams, failures and walkers."""

from __future__ import annotations

import torch
from hypothesis import given

from marl_explore.core.mapping import finishable
from marl_explore.core.rewards import REWARDS, checked
from marl_explore.core.sensing import field_of_view
from marl_explore.core.survivors import largest_of_living, mean_of_living, smallest_of_living
from marl_explore.core.world import advance, num_targets, start
from tests.helpers.strategies import repeatable
from tests.helpers.wide_worlds import wide_scenarios


def cells(positions):
    """Positions as lists, as tensors give them."""
    return [list(cell) for cell in positions]


def published(state):
    """What the package knows of a state, one arena a row, under the oracle's names."""
    targets = num_targets(state.target)
    known = targets.unsqueeze(-1) - state.missing
    share = known / targets.unsqueeze(-1)
    return {
        "positions": state.position,
        "maps": state.map,
        "fov": field_of_view(state.view),
        "linked": state.linked,
        "alive": state.alive,
        "walkers": state.walkers,
        "masks": state.action_mask,
        "unshared": state.unshared,
        "steps_since_merge": state.steps_since_merge,
        "finishable": finishable(
            state.obstacles, state.position, state.alive, state.map, state.target
        ),
        "largest": largest_of_living(share, state.alive),
        "smallest": smallest_of_living(share, state.alive),
        "mean": mean_of_living(share, state.alive),
    }


def expected(frame):
    """The oracle's values under the same names."""
    names = ("maps", "fov", "linked", "alive", "masks", "unshared", "steps_since_merge")
    return {
        **{name: getattr(frame, name) for name in (*names, "finishable")},
        "positions": cells(frame.positions),
        "walkers": cells(frame.walkers),
        **{name: frame.coverages[name] for name in ("largest", "smallest", "mean")},
    }


def assert_published(state, frames):
    oracle = [expected(frame) for frame in frames]
    for name, value in published(state).items():
        wanted = torch.tensor([row[name] for row in oracle], dtype=value.dtype)
        torch.testing.assert_close(value, wanted.view(value.shape), msg=f"{name}: {value} {wanted}")


def assert_recorded(record, frames):
    for name in ("dangerous", "merged", "discovered", "received"):
        assert getattr(record, name).tolist() == [getattr(frame, name) for frame in frames], name
    assert record.complete.tolist() == [frame.some_complete for frame in frames]
    for name, reward in REWARDS.items():
        own = checked(reward(record), record)
        wanted = torch.tensor([frame.rewards[name] for frame in frames])
        torch.testing.assert_close(own, wanted, rtol=1e-5, atol=1e-5, msg=name)
        team = torch.tensor([frame.team_rewards[name] for frame in frames])
        mean = mean_of_living(own, record.alive)
        torch.testing.assert_close(mean, team, rtol=1e-5, atol=1e-5, msg=name)


@repeatable(max_examples=150)
@given(scenario=wide_scenarios())
def test_whole_episodes_agree_with_the_oracle(scenario):
    worlds = scenario.worlds()
    state = start(scenario.config, **scenario.start())
    assert_published(state, [world.frame for world in worlds])
    for action in scenario.actions:
        state, record = advance(scenario.config, state, action)
        frames = [world.step(chosen) for world, chosen in zip(worlds, action.tolist(), strict=True)]
        assert_published(state, frames)
        assert_recorded(record, frames)
