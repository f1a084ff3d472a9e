"""The environment in the wider world: entries, given states, saved states, any batch."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from tensordict import TensorDict
from torchrl.envs import check_env_specs, step_mdp

from marl_explore import ArenaConfig, ExplorationEnv, make_env
from tests.helpers.strategies import repeatable
from tests.helpers.wide_worlds import wide_scenarios

ACTION = ("agents", "action")
WIDE = ArenaConfig(
    10,
    11,
    num_agents=4,
    sensing_range=(1.5, 2.0, 3.0, 3.0),
    sensing_shape="disc",
    line_of_sight=True,
    communication_range=(4.0, 4.0, 8.0, math.inf),
    wall_loss_db=6.0,
    path_loss_exponent=2.5,
    shadowing_db=4.0,
    message_loss=0.2,
    move_period=(1, 1, 2, 2),
    failure_rate=0.02,
    num_walkers=3,
)
OLD_ENTRIES = ("alive", "walkers", "draw_key", "reach")


def given_start(scenario):
    """The start of a scenario as ``reset(set_state=True)`` takes it."""
    start = scenario.start()
    agents = {key: start.pop(key) for key in ("position", "alive")}
    return TensorDict({**start, "agents": agents}, batch_size=[len(scenario.episodes)])


def acting(td, action):
    """An observation with actions of all robots."""
    return td.clone(recurse=False).set(ACTION, action)


def entries(td):
    """Entries of an observation that the oracle has, by its names."""
    agents = td["agents"]
    own = {name: agents[name] for name in ("linked", "alive", "dangerous", "merged", "discovered")}
    more = {name: agents[name] for name in ("received", "unshared", "steps_since_merge")}
    found = {
        **own,
        **more,
        "masks": agents["action_mask"],
        "positions": agents["position"],
        "maps": agents["map"],
        "fov": agents["observation", "fov"],
    }
    return found | {name: td[name] for name in ("walkers",) if name in td}


def assert_entries(td, frames):
    for name, value in entries(td).items():
        wanted = torch.tensor([getattr(frame, name) for frame in frames], dtype=value.dtype)
        assert value.equal(wanted.view(value.shape)), name


@repeatable(max_examples=40)
@given(scenario=wide_scenarios(max_side=12, max_steps=8))
def test_given_episodes_agree_with_the_oracle(scenario):
    worlds = scenario.worlds()
    env = ExplorationEnv(scenario.config, num_envs=len(worlds), terminate_at_coverage=1.0)
    td = env.reset(given_start(scenario), set_state=True)
    assert_entries(td, [world.frame for world in worlds])
    for action in scenario.actions:
        td = env.step(acting(td, action))["next"]
        frames = [world.step(own) for world, own in zip(worlds, action.tolist(), strict=True)]
        assert_entries(td, frames)
        wanted = torch.tensor([[frame.team_rewards["case2"]] for frame in frames])
        torch.testing.assert_close(td["reward"], wanted, atol=1e-5, rtol=1e-5)
        complete = [frame.some_complete or not any(frame.alive) for frame in frames]
        assert td["terminated"].flatten().tolist() == complete
        td = td.exclude("reward", "done", "terminated", "truncated")


def rolled(env, td, steps, seed=0):
    """Observations of some steps of random actions, which depend on the arena's own row only."""
    seen = [td]
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        action = torch.randint(0, 10, (4,), generator=generator).expand(env.num_envs, 4)
        td = step_mdp(env.step(acting(td, action.clone())))
        seen.append(td)
    return seen


@pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "make_env"])
def test_specs(make):
    check_env_specs(make(WIDE, num_envs=3))


def test_an_episode_is_the_same_in_any_batch():
    whole = ExplorationEnv(WIDE, num_envs=4, seed=3)
    one = ExplorationEnv(WIDE, num_envs=1, first_arena=2, seed=3)
    for all_rows, row in zip(
        rolled(whole, whole.reset(), 20), rolled(one, one.reset(), 20), strict=True
    ):
        assert (all_rows[2:3] == row).all()


def test_every_reset_draws_other_events():
    env = ExplorationEnv(WIDE, num_envs=2)
    keys = torch.cat([env.reset()["draw_key"] for _ in range(3)])
    assert len(keys.unique()) == 6


def test_arenas_that_start_at_other_times_do_not_disturb_each_other():
    env, other = (ExplorationEnv(WIDE, num_envs=2, seed=5) for _ in range(2))
    td, whole = env.reset(), other.reset()
    for _ in range(4):
        stay = torch.full((2, 4), 8)
        td, whole = (step_mdp(e.step(acting(t, stay))) for e, t in ((env, td), (other, whole)))
    td = env.reset(td.set("_reset", torch.tensor([[False], [True]])), set_state=False)
    assert td["step_count"].flatten().tolist() == [4, 0]
    for after, before in zip(rolled(env, td, 10), rolled(other, whole, 10), strict=True):
        assert (after[:1] == before[:1]).all()
    fresh = ExplorationEnv(WIDE, num_envs=1, first_arena=1, seed=5)
    fresh.reset()
    assert fresh.reset()["draw_key"].item() == td["draw_key"][1].item()


def test_an_episode_goes_on_from_what_was_observed():
    env, other = (ExplorationEnv(WIDE, num_envs=3, seed=1) for _ in range(2))
    *_, td = rolled(env, env.reset(), 15)
    state = td.select(
        "obstacles",
        "step_count",
        "draw_key",
        "walkers",
        *(("agents", key) for key in ("map", "position", "alive", "unshared", "steps_since_merge")),
    )
    resumed = other.reset(state, set_state=True)
    for key in ("linked", "action_mask"):
        assert resumed["agents", key].equal(td["agents", key]), key
    for one, two in zip(rolled(env, td, 10, 1)[1:], rolled(other, resumed, 10, 1)[1:], strict=True):
        assert (one == two).all()


def test_state_dict_restores_everything():
    env, other = (ExplorationEnv(WIDE, num_envs=3, seed=1) for _ in range(2))
    *_, td = rolled(env, env.reset(), 15)
    other.load_state_dict(env.state_dict())
    restored = other.reset()
    for one, two in zip(rolled(env, td, 10), rolled(other, restored, 10), strict=True):
        assert one.exclude("reward").keys() == two.exclude("reward").keys()
        for key in (("agents", "map"), ("agents", "alive"), "walkers", ("agents", "linked")):
            assert one[key].equal(two[key]), key


def older(state):
    """A state as a version without random events saved it."""
    return {name: value for name, value in state.items() if name not in OLD_ENTRIES}


@pytest.mark.parametrize("occlusion", [False, True])
def test_states_of_older_versions_can_be_loaded(occlusion):
    env, other = (ExplorationEnv(ArenaConfig(occlusion=occlusion), 2, seed=7) for _ in range(2))
    *_, td = rolled(env, env.reset(), 5)
    other.load_state_dict(older(env.state_dict()))
    restored = other.reset()
    assert restored["draw_key"].equal(td["draw_key"])
    for one, two in zip(rolled(env, td, 5)[1:], rolled(other, restored, 5)[1:], strict=True):
        assert (one == two).all()


@pytest.mark.parametrize(
    "settings",
    [
        {"sensing_shape": "disc"},
        {"wall_loss_db": 3.0},
        {"shadowing_db": 1.0},
        {"message_loss": 0.1},
        {"move_period": 2},
        {"failure_rate": 0.1},
        {"num_walkers": 1},
        {"communication_range": (1.0, 2.0, 3.0, 4.0)},
        {"line_of_sight": True, "sensing_range": 2.0},
    ],
    ids=lambda settings: next(iter(settings)),
)
def test_states_of_older_versions_are_refused_in_a_wider_world(settings):
    env = ExplorationEnv(ArenaConfig(**settings), num_envs=2)
    env.reset()
    with pytest.raises(ValueError, match=f"{next(iter(settings))}=.* is not allowed: .*state_dict"):
        env.load_state_dict(older(env.state_dict()))


def wide_start(**changes):
    """A start of an open arena of 6 x 6 cells with two robots and two walkers."""
    start = {
        "obstacles": torch.zeros(1, 6, 6, dtype=torch.bool),
        "walkers": torch.tensor([[[4, 4], [5, 5]]]),
        "position": torch.tensor([[[0, 0], [1, 1]]]),
        "alive": torch.ones(1, 2, dtype=torch.bool),
        **changes,
    }
    agents = {key: start.pop(key) for key in ("position", "alive")}
    return TensorDict({**start, "agents": agents}, batch_size=[1])


WALL = torch.zeros(1, 6, 6, dtype=torch.bool)
WALL[0, 4, 4] = True


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"walkers": torch.tensor([[[6, 0], [5, 5]]])}, r"walker 0 in arena 0: .* is outside"),
        ({"obstacles": WALL}, r"walker 0 in arena 0: cell \(4, 4\) is an obstacle"),
        ({"walkers": torch.tensor([[[5, 5], [5, 5]]])}, r"walker 0 .* more than one walker"),
        ({"walkers": torch.tensor([[[5, 5], [1, 1]]])}, r"walker 1 in arena 0: .* holds a robot"),
        ({"walkers": torch.tensor([[[5, 5]]])}, r"'walkers' must be .* \(1, 2, 2\)"),
        ({"alive": torch.ones(1, 3, dtype=torch.bool)}, r"'alive'\) must be .*\(1, 2\)"),
        ({"draw_key": torch.zeros(1, 1)}, r"'draw_key' must be torch.int64"),
    ],
)
def test_given_events_that_cannot_be_are_refused(changes, message):
    env = ExplorationEnv(ArenaConfig(6, 6, num_agents=2, num_walkers=2))
    env.reset(wide_start(), set_state=True)
    with pytest.raises(ValueError, match=message):
        env.reset(wide_start(**changes), set_state=True)


def test_walkers_are_refused_where_there_are_none():
    env = ExplorationEnv(ArenaConfig(6, 6, num_agents=2))
    with pytest.raises(ValueError, match="'walkers' is not allowed with num_walkers=0"):
        env.reset(wide_start(), set_state=True)


def test_an_episode_ends_when_no_robot_is_left():
    env = ExplorationEnv(ArenaConfig(failure_rate=1.0), num_envs=2)
    td = env.reset()
    assert td["agents", "alive"].all()
    assert not td["terminated"].any()
    td = env.step(acting(td, torch.full((2, 4), 8)))["next"]
    assert not td["agents", "alive"].any()
    assert td["terminated"].all()
    assert td["reward"].flatten().tolist() == [0.0, 0.0]
    assert td["agents", "action_mask"].sum(-1).eq(1).all()  # staying only


def test_the_defaults_have_no_entry_of_walkers_and_all_robots_live():
    td = ExplorationEnv(num_envs=2).reset()
    assert "walkers" not in td
    assert td["agents", "alive"].all()
