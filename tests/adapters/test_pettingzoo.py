"""The task through PettingZoo is the task: its own conformance tests, and the same episodes."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch
from pettingzoo.test import (
    api_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
)
from pettingzoo.utils import parallel_to_aec
from torchrl.envs import MarlGroupMapType, PettingZooWrapper, check_env_specs

from marl_explore import ArenaConfig, make_env
from marl_explore.adapters.pettingzoo import parallel_env
from tests.helpers.boards import actions, arena

SMALL = ArenaConfig(height=6, width=5, num_agents=3, communication_range=1.0)


def features(agents, robot):
    """FOV, FPR and NET of a robot in a row."""
    parts = [agents["observation", key][0, robot].flatten() for key in ("fov", "fpr", "net")]
    return torch.cat(parts).numpy()


def make(**options):
    return parallel_env(SMALL, max_steps=20, **options)


def make_aec(**options):
    return parallel_to_aec(make(**options))


def test_it_passes_the_parallel_api_test():
    parallel_api_test(make(), num_cycles=100)


def test_it_passes_the_parallel_seed_test():
    parallel_seed_test(make)


def test_it_passes_the_api_test_agent_by_agent():
    with warnings.catch_warnings():  # of observations that are dictionaries
        warnings.filterwarnings("ignore", "Observation", category=UserWarning)
        api_test(make_aec(), num_cycles=100)


def test_it_passes_the_seed_test_agent_by_agent():
    seed_test(make_aec, num_cycles=100)


def test_it_passes_the_render_test_agent_by_agent():
    render_test(make_aec)


@pytest.mark.parametrize(("reward", "shared"), [("case1", True), ("case2", False), ("team", True)])
def test_the_same_seed_and_actions_give_the_episodes_of_the_torchrl_env(reward, shared):
    options = {"reward": reward, "max_steps": 15, "seed": 4, "fpr": "proximity"}
    ours = make_env(SMALL, **options, terminate_at_coverage=0.7)
    other = parallel_env(SMALL, **options, terminate_at_coverage=0.7, shared_reward=shared)
    generator = torch.Generator().manual_seed(0)
    ended = set()
    for _ in range(6):
        observation, (seen, infos) = ours.reset(), other.reset()
        while True:
            agents = observation["agents"]
            for i, agent in enumerate(other.possible_agents):
                assert np.array_equal(seen[agent]["observation"], features(agents, i))
                mask = agents["action_mask"][0, i].numpy()
                assert np.array_equal(seen[agent]["action_mask"], mask)
                assert list(infos[agent]) == ["action_mask"]
                assert np.array_equal(infos[agent]["action_mask"], mask)
                assert other.observation_space(agent).contains(seen[agent])
            if not other.agents:
                break
            action = torch.randint(10, (1, 3), generator=generator)
            observation["agents", "action"] = action
            observation = ours.step(observation)["next"]
            chosen = dict(zip(other.agents, action[0].tolist(), strict=True))
            seen, rewards, *ends, infos = other.step(chosen)
            for key, values in zip(("terminated", "truncated"), ends, strict=True):
                assert set(values.values()) == {observation[key].item()}, key
            own = observation["agents", "individual_reward"].flatten().tolist()
            team = [observation["reward"].item()] * 3
            assert [rewards[agent] for agent in other.possible_agents] == (team if shared else own)
        ended.add((observation["terminated"].item(), observation["truncated"].item()))
    assert len(ended) > 1  # some arenas were covered, others took too long


def test_features_fill_their_space():
    env = parallel_env(SMALL, fpr=None)
    high = env.observation_space("robot_0")["observation"].high
    assert high.tolist() == [1] * 9 + [30] * 24 + [1] * 3


def test_robots_draw_from_spaces_of_their_own():
    env = parallel_env(SMALL)
    one, other = map(env.observation_space, env.possible_agents[:2])
    other.seed(1)
    expected = other.sample()
    other.seed(1)
    one.seed(2)
    assert np.array_equal(other.sample()["observation"], expected["observation"])


def test_another_first_arena():
    states = {}
    for seed, first in ((0, 0), (0, 1), (5, 1)):
        env = parallel_env(SMALL, first_arena=first)
        env.reset(seed)
        states[seed, first] = env.state()
    second = make_env(SMALL, num_envs=2).reset()["obstacles"][1].flatten()
    assert np.array_equal(states[0, 1][:30], second)
    assert len({state.tobytes() for state in states.values()}) == 3


def test_reset_goes_on_to_the_next_arena_and_a_seed_starts_again():
    env = parallel_env(SMALL)
    states = []
    for seed in (None, None, 7, None, 7):
        env.reset(seed)
        states.append(env.state())
    assert not np.array_equal(states[0], states[1])
    assert not np.array_equal(states[2], states[3])
    assert np.array_equal(states[2], states[4])


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using version")
def test_torchrl_wraps_it_with_masks():
    env = PettingZooWrapper(
        parallel_env(SMALL, max_steps=8),
        group_map=MarlGroupMapType.ALL_IN_ONE_GROUP,
        categorical_actions=True,
        return_state=True,
        seed=3,
    )
    check_env_specs(env)
    env.set_seed(3)
    ours = make_env(SMALL, max_steps=8, seed=3)
    ours.reset()  # as set_seed of the wrapper does
    steps = env.rollout(20)
    assert len(steps) == 8
    observation = ours.reset()
    for step in steps:
        agents = observation["agents"]
        seen = step["agents", "observation", "observation"]
        assert [row.tolist() for row in seen] == [features(agents, i).tolist() for i in range(3)]
        mask = step["agents", "action_mask"]
        assert mask.equal(agents["action_mask"][0])
        assert mask.gather(-1, step["agents", "action"].unsqueeze(-1)).all()
        assert env.state_space.contains(step["state"].numpy())
        agents["action"] = step["agents", "action"].unsqueeze(0)
        observation = ours.step(observation)["next"]
        assert (step["next", "agents", "reward"] == observation["reward"]).all()


def test_given_starts():
    obstacles, positions = arena("""
        #....
        ..0..
        .1...
        ...#.
    """)
    env = parallel_env(ArenaConfig(height=4, width=5, num_agents=2), render_mode="ansi")
    env.reset(options={"obstacles": obstacles.numpy(), "positions": positions.tolist()})
    assert env.render().splitlines() == ["?...?", "..0.?", ".1..?", "...??"]
    env.step(dict(zip(env.agents, actions("E S").tolist(), strict=True)))
    assert env.render().splitlines() == ["?....", "...0.", ".....", ".1.??"]
    state = env.state()
    assert env.state_space.contains(state)
    assert np.array_equal(state[:20].reshape(4, 5), obstacles.numpy())
    assert state[-4:].tolist() == pytest.approx([1 / 4, 3 / 5, 3 / 4, 1 / 5])


def test_an_image_shows_what_the_team_knows():
    env = parallel_env(SMALL, render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (96, 80, 3)
    assert picture.dtype == np.uint8
    env.render_mode = "ansi"
    centres = picture[8::16, 8::16].reshape(-1, 3).tolist()
    corners = picture[::16, ::16].reshape(-1, 3).tolist()
    shades = {"?": [0xB8] * 3, ".": [0xFF] * 3, "#": [0x40] * 3}
    for symbol, centre, corner in zip(
        env.render().replace("\n", ""), centres, corners, strict=True
    ):
        assert corner == shades.get(symbol, [0xFF] * 3)
        assert (centre == corner) == (symbol in shades)


def test_without_a_render_mode_nothing_is_drawn():
    env = parallel_env(SMALL)
    env.reset()
    assert env.render() is None


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"robot_0": 8, "robot_1": 8}, r"actions\['robot_2'\]=None is not allowed"),
        ({"robot_0": 8, "robot_1": 8, "robot_2": 10}, r"actions\['robot_2'\]=10 is not allowed"),
        ({"robot_0": -1, "robot_1": 8, "robot_2": 8}, r"actions\['robot_0'\]=-1 is not allowed"),
        ({"robot_0": 8, "robot_1": 1.5, "robot_2": 8}, r"actions\['robot_1'\]=1.5 is not allowed"),
        ({"robot_0": 8, "robot_1": 8, "robot_2": 8, "robot_3": 8}, r"actions of \['robot_3'\]"),
    ],
)
def test_every_robot_needs_one_of_the_ten_actions(chosen, message):
    env = parallel_env(SMALL)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.step(chosen)


@pytest.mark.parametrize(
    "kind",
    [np.int64, np.uint8, lambda n: np.array([n]), np.array, torch.tensor],
    ids=["int64", "uint8", "array of one", "array", "tensor"],
)
def test_actions_and_seeds_may_be_integers_of_any_library(kind):
    env, other = parallel_env(SMALL), parallel_env(SMALL, seed=kind(5))
    assert np.array_equal(first_state(env, 5), first_state(other))
    for seed in (7, 5):  # a seed leaves nothing behind that breaks later resets
        assert np.array_equal(first_state(env, kind(seed)), first_state(other, seed))
        assert np.array_equal(first_state(env), first_state(other))
    for action in (1, 9, 8):
        one = env.step({agent: kind(action) for agent in env.agents})
        two = other.step(dict.fromkeys(other.agents, action))
        assert one[1:4] == two[1:4]
    assert np.array_equal(env.state(), other.state())


def first_state(env, seed=None):
    env.reset(seed)
    return env.state()


@pytest.mark.parametrize(
    "seed", [-1, np.int64(-1), 1.5, np.float64(2), "x", 2**64, 2**70, True, np.array([1, 2])]
)
def test_other_seeds_are_refused_and_leave_the_episode(seed):
    env, other = parallel_env(SMALL), parallel_env(SMALL)
    env.reset(3), other.reset(3)
    with pytest.raises(ValueError, match=r"seed=.* is not allowed: it must be an integer of at "):
        env.reset(seed)
    with pytest.raises(ValueError, match=r"seed=.* is not allowed: it must be an integer of at "):
        parallel_env(SMALL, seed=seed)
    stay = dict.fromkeys(env.agents, 8)
    assert env.step(stay)[1:4] == other.step(stay)[1:4]
    assert np.array_equal(first_state(env), first_state(other))


FREE = {"obstacles": np.zeros((6, 5), bool), "positions": [[0, 0], [1, 1], [2, 2]]}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"positions": FREE["positions"]}, r"options=\['positions'\] is not allowed: give both"),
        ({**FREE, "walls": 1}, r"options\['walls'\] is not allowed: use both of \('obstacles', "),
        ({"obstacle": 1}, r"options\['obstacle'\] is not allowed"),
        ({**FREE, "positions": [[0, 0]] * 3}, "holds more than one robot"),
        ({**FREE, "positions": [[0, 0], [1, 1], [6, 0]]}, "outside the arena"),
        ({**FREE, "positions": [[0, 0], [1, 1]]}, "position"),
        ({**FREE, "obstacles": np.zeros((6, 5))}, "obstacles"),
        ({**FREE, "obstacles": np.zeros((5, 6), bool)}, "obstacles"),
    ],
)
def test_wrong_options_are_named_and_leave_the_episode(options, message):
    env, other = parallel_env(SMALL), parallel_env(SMALL)
    env.reset(3), other.reset(3)
    with pytest.raises(ValueError, match=message):
        env.reset(seed=9, options=options)
    assert np.array_equal(env.state(), other.state())
    assert np.array_equal(first_state(env), first_state(other))  # the numbering too


def test_wrong_arguments_are_named():
    allowed = r"None or one of \('human', 'rgb_array', 'ansi'\)"
    with pytest.raises(ValueError, match=f"render_mode='film' is not allowed: use {allowed}"):
        parallel_env(SMALL, render_mode="film")
    with pytest.raises(ValueError, match="max_steps=0"):
        parallel_env(SMALL, max_steps=0)
    env = parallel_env(SMALL)
    with pytest.raises(RuntimeError, match="call reset"):
        env.step({})
    with pytest.raises(RuntimeError, match="call reset"):
        env.state()


@pytest.mark.parametrize(
    "options",
    [
        5,
        "obstacles",
        {"obstacles": "abc", "positions": "x"},
        {"obstacles": None, "positions": None},
        {"obstacles": [[0, 1], [0]], "positions": [[0, 0]]},
    ],
)
def test_options_of_another_kind_are_refused_and_the_episode_goes_on(options):
    env = parallel_env(max_steps=5)
    env.reset(seed=1)
    with pytest.raises(ValueError, match="options"):
        env.reset(options=options)
    env.step(dict.fromkeys(env.agents, 8))


# ------------------------------------------------------------------- robots that fail

FAILING = ArenaConfig(
    8, 8, num_agents=3, failure_rate=0.1, num_walkers=2, sensing_range=2.0, line_of_sight=True
)


def make_failing(**options):
    return parallel_env(FAILING, max_steps=60, **options)


def test_it_passes_the_api_tests_while_robots_fail():
    parallel_api_test(make_failing(), num_cycles=200)
    parallel_seed_test(make_failing)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Observation", category=UserWarning)
        api_test(parallel_to_aec(make_failing()), num_cycles=200)


@pytest.mark.parametrize("shared", [True, False])
def test_robots_that_fail_leave_the_agents(shared):
    env, ours = make_failing(seed=4, shared_reward=shared), make_env(FAILING, max_steps=60, seed=4)
    env.reset()
    now = ours.reset()
    fewest = len(env.agents)
    while env.agents:
        before = list(env.agents)
        _, rewards, terminated, truncated, infos = env.step(dict.fromkeys(before, 8))
        now = ours.step(now.set(("agents", "action"), torch.full((1, 3), 8)))["next"]
        alive = dict(zip(env.possible_agents, now["agents", "alive"][0].tolist(), strict=True))
        done = bool(now["terminated"])
        assert terminated == {agent: done or not alive[agent] for agent in before}
        assert set(rewards) == set(truncated) == set(infos) == set(before)
        own = now["agents", "individual_reward"][0, :, 0].tolist()
        for agent, reward in rewards.items():
            expected = now["reward"].item() if shared else own[env.possible_agents.index(agent)]
            assert reward == expected
        if not now["done"]:
            assert env.agents == [agent for agent in before if alive[agent]]
        fewest = min(fewest, len(env.agents) or fewest)
        now = now.exclude("reward", "done", "terminated", "truncated")
    assert fewest < 3


def test_a_robot_that_failed_is_a_stranger():
    env = make_failing(seed=4)
    env.reset()
    while len(env.agents) == 3:
        env.step(dict.fromkeys(env.agents, 8))
    with pytest.raises(ValueError, match="are not allowed: the robots are"):
        env.step(dict.fromkeys(env.possible_agents, 8))
