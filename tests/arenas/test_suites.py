"""Suites: frozen arenas under versioned names, usable in training."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from marl_explore import ArenaConfig, ExplorationEnv, make_env
from marl_explore.arenas import (
    Caves,
    Mazes,
    Mixed,
    Rooms,
    Uniform,
    UniformV2,
    default_config,
    default_number,
    default_steps,
    fit,
    list_suites,
    resolve,
    suite,
)
from marl_explore.arenas.suites import SUITES
from marl_explore.core.hashing import stream_seed
from tests.helpers.drawing import drawn

IDS = [entry.id for entry in SUITES]
OF_ROBOTS = ("lidar-32", "radio-32", "mixed-team-32", "faulty-32")
"""Suites that bring their robots."""


def test_the_names():
    assert list_suites() == ["uniform", "uniform-v2", "mixed", *IDS]
    assert set(IDS) >= {
        "paper-12-v1",
        "open-24-v1",
        "rooms-32-v1",
        "maze-32-v1",
        "cave-48-v1",
        "corridor-24-v1",
        *(f"{name}-v1" for name in OF_ROBOTS),
    }


@pytest.mark.parametrize("name", IDS)
def test_a_version_draws_the_arenas_it_always_drew(name):
    assert suite(name).fingerprint() == suite(name).digest


def test_the_fingerprint_is_that_of_the_arenas_of_a_fresh_environment():
    one = suite("paper-12")
    arenas = ExplorationEnv(arenas="paper-12", num_envs=200, stream="test", seed=0)
    start = arenas.reset()
    generate = one.make(one.config)
    obstacles, positions = drawn(generate, 200, stream_seed("test", 0))
    assert torch.equal(start["obstacles"], obstacles)
    assert torch.equal(start["agents", "position"], positions)
    assert one.fingerprint(199) != one.fingerprint(200)


@pytest.mark.parametrize("name", IDS)
def test_the_density_is_the_mean_share_of_obstacles(name):
    entry = suite(name)
    obstacles, _ = drawn(entry.make(entry.config), 200)
    assert obstacles.float().mean().item() == pytest.approx(entry.config.obstacle_density, abs=0.01)


def test_paper_12_is_the_uniform_arena_of_the_paper():
    named, plain = (ExplorationEnv(arenas=name, num_envs=5) for name in ("paper-12", "uniform"))
    assert (named.reset() == plain.reset()).all()


@pytest.mark.parametrize("kind", [Rooms, Mixed])
def test_a_generator_brings_its_configuration(kind):
    config = ArenaConfig(height=14, width=9, num_agents=2)
    env = ExplorationEnv(arenas=kind(config), num_envs=6)
    assert env.config == config
    assert env.reset()["obstacles"].shape == (6, 14, 9)


def test_a_name_without_version_is_the_newest(monkeypatch):
    assert suite("rooms-32") is suite("rooms-32-v1")
    newer = [replace(suite("rooms-32"), version=version) for version in (10, 9)]
    monkeypatch.setattr("marl_explore.arenas.suites.SUITES", (*SUITES, *newer))
    assert suite("rooms-32").version == 10
    assert suite("rooms-32-v1").version == 1


@pytest.mark.parametrize("name", ["rooms", "rooms-32-v7", "rooms-32-v", ""])
def test_unknown_suites_are_refused_with_the_known_ones(name):
    with pytest.raises(ValueError, match=f"arenas='{name}' is not a suite.*rooms-32-v1.*uniform"):
        resolve(name, ArenaConfig())


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("rooms-32", {"height": 12}, "height=12 .*='rooms-32-v1' has 32; leave height to"),
        ("maze-32-v1", {"width": 33}, r"width=33 .*='maze-32-v1' has 32"),
        ("open-24", {"obstacle_density": 0.2}, "obstacle_density=0.2 .* has 0.1"),
        ("rooms-32", {"obstacle_density": 0.1}, "obstacle_density=0.1 .* has 0.15"),
        ("lidar-32", {"num_agents": 5}, "num_agents=5 .*='lidar-32-v1' has 4; leave num_agents to"),
        ("radio-32", {"message_loss": 0.0}, "message_loss=0.0 .*='radio-32-v1' has 0.1"),
        ("mixed-team-32", {"move_period": 1}, r"move_period=1 .* has \(1, 1, 2, 2\)"),
        ("faulty-32", {"num_walkers": 0}, "num_walkers=0 .* has 4"),
    ],
)
def test_configurations_of_other_arenas_are_refused(name, change, message):
    with pytest.raises(ValueError, match=message):
        ExplorationEnv(replace(suite(name).config, **change), arenas=name)


def test_robots_and_ranges_may_differ_from_the_suite():
    config = replace(suite("rooms-32").config, num_agents=7, communication_range=9.0)
    env = ExplorationEnv(config, num_envs=3, arenas="rooms-32")
    plain = ExplorationEnv(num_envs=3, arenas="rooms-32")
    assert torch.equal(env.reset()["obstacles"], plain.reset()["obstacles"])
    assert env.config is config


def test_without_a_configuration_the_arenas_bring_their_own():
    assert ExplorationEnv(arenas="cave-48").config == suite("cave-48").config
    rooms = Rooms(ArenaConfig(height=20, width=14, num_agents=2))
    assert ExplorationEnv(arenas=rooms).config == rooms.config
    assert ExplorationEnv(arenas=Uniform(ArenaConfig())).config == ArenaConfig()


@pytest.mark.parametrize("name", IDS)
def test_every_reset_in_a_training_run_draws_the_arena_of_its_episode(name):
    """Arenas end at different times, and auto-reset moves each one to its own next episode."""
    config = suite(name).config
    ends = 60 / config.num_cells
    env = make_env(config, 6, arenas=name, seed=4, first_arena=10, terminate_at_coverage=ends)
    generate = suite(name).make(config)
    seed, arenas, episodes = stream_seed("train", 4), torch.arange(6) + 10, torch.zeros(6).long()
    torch.manual_seed(0)
    td = env.reset()
    for _ in range(60):
        expected = generate(seed, arenas, episodes)
        assert torch.equal(td["obstacles"], expected[0])
        fresh = td["step_count"].squeeze(-1) == 0
        assert torch.equal(td["agents", "position"][fresh], expected[1][fresh])
        step, td = env.step_and_maybe_reset(env.rand_action(td))
        episodes += step["next", "done"].squeeze(-1)
    assert len(episodes.unique()) > 1


COMMON = {
    "height": 32,
    "width": 32,
    "obstacle_density": 0.24,
    "sensing_shape": "disc",
    "line_of_sight": True,
}
RADIO = {
    "sensing_range": 3.5,
    "communication_range": 8.0,
    "wall_loss_db": 6.0,
    "path_loss_exponent": 2.5,
    "shadowing_db": 4.0,
    "message_loss": 0.1,
}
OWN = {
    "lidar-32": {"sensing_range": 3.5, "communication_range": 5.0, "wall_loss_db": math.inf},
    "radio-32": RADIO,
    "mixed-team-32": {
        "sensing_range": (1.5, 1.5, 4.0, 4.0),
        "communication_range": (4.0, 4.0, 8.0, 8.0),
        "wall_loss_db": math.inf,
        "move_period": (1, 1, 2, 2),
    },
    "faulty-32": {**RADIO, "num_agents": 6, "failure_rate": 0.001, "num_walkers": 4},
}


@pytest.mark.parametrize("name", OF_ROBOTS)
def test_suites_that_bring_their_robots_have_these_settings(name):
    entry = suite(name)
    assert entry.brings_robots
    assert entry.config == ArenaConfig(**COMMON, **OWN[name])
    assert fit(ArenaConfig(num_agents=2, communication_range=(1.0, 2.0)), name) == entry.config
    assert default_config(name) == entry.config
    assert (default_steps(name), default_number(name)) == (1000, 40)


def test_other_suites_leave_the_robots_alone():
    others = [entry for entry in SUITES if entry.name not in OF_ROBOTS]
    robots = ArenaConfig(num_agents=2, communication_range=(1.0, 2.0), failure_rate=0.5)
    for entry in others:
        size = {n: getattr(entry.config, n) for n in ("height", "width", "obstacle_density")}
        assert not entry.brings_robots
        assert entry.fit(robots) == replace(robots, **size)
        assert default_number(entry.id) == 200


@pytest.mark.parametrize("name", OF_ROBOTS)
def test_they_have_rooms_caves_mazes_and_open_ground_in_turn(name):
    config = suite(name).config
    alone = (
        Rooms(config, "clustered"),
        Caves(config, "clustered"),
        Mazes(config, "clustered"),
        UniformV2(replace(config, obstacle_density=0.1), "clustered"),
    )
    arenas, episodes = torch.arange(24) + 3, torch.arange(24) % 5
    obstacles, positions = suite(name).generator(config)(7, arenas, episodes)
    for number, kind in enumerate(alone):
        rows = arenas % 4 == number
        for mixed, whole in zip((obstacles, positions), kind(7, arenas, episodes), strict=True):
            assert torch.equal(mixed[rows], whole[rows])


def test_they_share_obstacles():
    arenas, episodes = torch.arange(12), torch.arange(12) % 3
    first, *others = (suite(n).make(suite(n).config)(5, arenas, episodes)[0] for n in OF_ROBOTS)
    assert all(torch.equal(first, other) for other in others)
