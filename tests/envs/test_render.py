"""How an environment shows itself: text, images and repr."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import ImageColor
from tensordict import TensorDict
from torchrl.envs import TransformedEnv
from torchrl.record import PixelRenderTransform

from marl_explore import ArenaConfig, ExplorationEnv, Rooms, make_env
from marl_explore.core.rewards import case1
from marl_explore.utils.palette import FREE_COLOR, WALKER_COLOR, robot_color
from tests.helpers.boards import arena

SMALL = ArenaConfig(height=4, width=5, num_agents=2)


@pytest.mark.parametrize("make", [ExplorationEnv, make_env], ids=["env", "make_env"])
def test_it_shows_what_the_team_knows_in_one_arena(make):
    env = make(SMALL, num_envs=2)
    boards = ["#....\n..0..\n.1...\n...#.", ".....\n...0.\n#....\n1...."]
    obstacles, positions = map(torch.stack, zip(*map(arena, boards), strict=True))
    agents = TensorDict({"position": positions}, batch_size=[2, 2])
    env.reset(TensorDict({"obstacles": obstacles, "agents": agents}, [2]), set_state=True)
    assert env.render().splitlines() == ["?...?", "..0.?", ".1..?", "...??"]
    assert env.render("ansi", arena=1).splitlines() == ["??...", "??.0.", "#....", "1.???"]
    image = env.render(mode="rgb_array", arena=1)
    assert image.shape == (64, 80, 3)
    assert image.dtype == np.uint8
    shades = {"?": 0xB8, ".": 0xFF, "#": 0x40, "0": 0xFF, "1": 0xFF}  # a robot stands on free cells
    expected = [[shades[symbol] for symbol in row] for row in env.render(arena=1).splitlines()]
    assert (image[::16, ::16] == np.array(expected)[..., None]).all()


def test_pixels_of_torchrl():
    env = TransformedEnv(ExplorationEnv(SMALL), PixelRenderTransform(mode="rgb_array"))
    pixels = env.rollout(3)["pixels"]
    assert np.asarray(pixels[0][-1]).shape == (64, 80, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"mode": "human"}, r"mode='human' is not allowed: .*\('ansi', 'rgb_array'\)"),
        ({"arena": 2}, "arena=2 is not allowed: there are 2 arenas"),
        ({"arena": -1}, "arena=-1 is not allowed"),
        ({"arena": 0.5}, "arena=0.5 is not allowed"),
    ],
)
def test_wrong_arguments_are_named(arguments, message):
    env = ExplorationEnv(SMALL, num_envs=2)
    env.reset()
    with pytest.raises(ValueError, match=message):
        env.render(**arguments)


def test_before_a_reset_there_is_nothing_to_show():
    with pytest.raises(RuntimeError, match="call reset"):
        ExplorationEnv().render()


def test_repr_tells_sizes_and_settings():
    env = make_env(SMALL, num_envs=3, reward="team", max_steps=7, seed=2, first_arena=6)
    told = (
        "ExplorationEnv(num_envs=3, robots=2, cells=4x5, reward='team', arenas='uniform', "
        "max_steps=7, seed=2, stream='train', first_arena=6, device=cpu)"
    )
    assert repr(env.base_env) == told
    assert told in repr(env)
    env.set_seed(9)
    assert "seed=9" in repr(env)
    config = ArenaConfig(height=12, width=12)
    other = repr(ExplorationEnv(config, reward=case1, arenas=Rooms(config)))
    assert "reward=case1, arenas=Rooms" in other


def test_failed_robots_and_walkers_are_shown_and_lost_knowledge_is_not():
    env = ExplorationEnv(ArenaConfig(4, 5, 0.0, num_agents=2, num_walkers=1))
    agents = {
        "position": torch.tensor([[[0, 0], [3, 4]]]),
        "alive": torch.tensor([[True, False]]),
        "map": torch.zeros(1, 2, 4, 5, dtype=torch.int8),
        "unshared": torch.zeros(1, 2, 2, dtype=torch.int64),
        "steps_since_merge": torch.zeros(1, 2, 2, dtype=torch.int64),
    }
    agents["map"][0, 0, :, 2:] = -1
    start = {
        "obstacles": torch.zeros(1, 4, 5, dtype=torch.bool),
        "walkers": torch.tensor([[[1, 1]]]),
        "step_count": torch.tensor([[1]]),
        "agents": agents,
    }
    env.reset(TensorDict(start, batch_size=[1]), set_state=True)
    assert env.render().splitlines() == ["0.???", ".*???", "..???", "..??x"]
    image = env.render("rgb_array")
    assert image[24, 24].tolist() == list(ImageColor.getrgb(WALKER_COLOR))
    assert image[3 * 16 + 8, 4 * 16 + 8].tolist() == list(ImageColor.getrgb(FREE_COLOR))
    assert image[3 * 16 + 5, 4 * 16 + 5].tolist() == list(ImageColor.getrgb(robot_color(1)))
