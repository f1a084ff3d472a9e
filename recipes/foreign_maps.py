"""FPR and NET on other maps: those of a PettingZoo environment, and a data set of map files.

python recipes/foreign_maps.py pursuit

python recipes/foreign_maps.py files office.yaml arena.map cave.txt

The two transforms need maps and positions, under any names. Pursuit, a PettingZoo environment,
shows pursuers a square around them and has neither; a transform in this recipe makes them. Map
files become a replay buffer of partly known maps. Pursuit needs the extra "pursuit"
(``pip install ".[pursuit]"``).
"""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from pettingzoo import ParallelEnv
from pettingzoo.utils import BaseParallelWrapper
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torch.nn.functional import pad
from torchrl.data import (
    Bounded,
    Composite,
    LazyTensorStorage,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import Compose, PettingZooWrapper, Transform, TransformedEnv

from marl_explore import (
    CommunicationNeighbors,
    FrontierReachability,
    load_map,
    require_integer,
    run_program,
    suite,
    tables,
)

UNKNOWN, OCCUPIED = -1, 1
DIRECTIONS = ("N", "NE", "E", "SE", "S", "SW", "W", "NW")
RANGE_CELLS, SENSED_CELLS = 6.0, 5


class Located(BaseParallelWrapper[str, Any, int]):
    """Pursuit with the cell of every pursuer in its info, "cell" int64 [2] (row, column)."""

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
        """As Pursuit's, with cells in the infos."""
        return super().reset(seed, options)[0], self._cells()

    def step(self, actions: dict[str, int]) -> tuple[dict[str, Any], ...]:
        """As Pursuit's, with cells in the infos."""
        return *super().step(actions)[:-1], self._cells()

    def _cells(self) -> dict[str, dict[str, Any]]:
        layer = self.unwrapped.env.pursuer_layer
        places = [layer.get_position(i)[::-1] for i in range(layer.n_agents())]  # it gives (x, y)
        return {
            name: {"cell": np.array(place, np.int64)}
            for name, place in zip(self.possible_agents, places, strict=True)
        }


class MapsFromViews(Transform):
    """Writes what each pursuer has seen since the reset, "map", and where it is, "position".

    Reads "observation" float [*B, N, 2k+1, 2k+1, 3], whose first channel is 1 for walls, and
    ("info", "cell") of the group; writes int8 [*B, N, H, W] and int64 [*B, N, 2].
    """

    def __init__(self, group: str, height: int, width: int) -> None:
        super().__init__(in_keys=[group], out_keys=[group])
        self.group, self.height, self.width = group, height, width

    def _reset(self, _: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        position = tensordict_reset[self.group, "info", "cell"]
        shape = (*position.shape[:-1], self.height, self.width)
        return self._see(torch.full(shape, UNKNOWN, dtype=torch.int8), tensordict_reset)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return self._see(tensordict[self.group, "map"], next_tensordict)

    def _see(self, grid: Tensor, now: TensorDictBase) -> TensorDictBase:
        """Write the views into the maps, with a border for cells outside."""
        walls = now[self.group, "observation"][..., 0]
        position = now[self.group, "info", "cell"].long()
        k = walls.shape[-1] // 2
        steps = torch.arange(2 * k + 1)
        row, column = position[..., :1, None] + steps[:, None], position[..., 1:, None] + steps
        stride = self.width + 2 * k
        bordered = pad(grid, (k,) * 4).flatten(-2)
        seen = bordered.scatter(
            -1, (row * stride + column).flatten(-2), walls.flatten(-2).to(torch.int8)
        )
        now[self.group, "map"] = seen.unflatten(-1, (-1, stride))[..., k:-k, k:-k].contiguous()
        now[self.group, "position"] = position
        return now

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add both entries; with their bounds the following transforms need not check all cells."""
        robots = observation_spec[self.group].shape
        last = torch.tensor([self.height, self.width]).expand(*robots, 2) - 1
        shape = (*robots, self.height, self.width)
        observation_spec[self.group, "map"] = Bounded(UNKNOWN, OCCUPIED, shape, dtype=torch.int8)
        observation_spec[self.group, "position"] = Bounded(
            torch.zeros_like(last), last, dtype=torch.int64
        )
        return observation_spec


def pursuit_env(seed: int = 0) -> TransformedEnv:
    """Eight pursuers on 16 x 16 cells, who also observe their map, FPR and NET."""
    try:
        from pettingzoo.sisl import pursuit_v5
    except ModuleNotFoundError as error:
        sys.exit(f'error: this program needs {error.name}: pip install "marl-explore[pursuit]"')

    env: ParallelEnv[str, Any, int] = Located(pursuit_v5.parallel_env(max_cycles=100))
    with warnings.catch_warnings():  # about the version that it was tested with
        warnings.filterwarnings("ignore", "PettingZoo in TorchRL is tested")
        wrapped = PettingZooWrapper(env, group_map={"pursuers": env.possible_agents}, seed=seed)
    grid, cell = ("pursuers", "map"), ("pursuers", "position")
    return TransformedEnv(
        wrapped,
        Compose(
            MapsFromViews("pursuers", height=16, width=16),
            FrontierReachability(grid, cell, ("pursuers", "fpr"), normalize=None),
            CommunicationNeighbors(cell, ("pursuers", "net"), RANGE_CELLS),
        ),
    )


def partly_known(obstacles: Tensor, robots: int, generator: torch.Generator) -> TensorDictBase:
    """Robots on random free cells of a map bool [H, W]; each knows the cells around it."""
    height, width = obstacles.shape
    free = (~obstacles).flatten().float()
    cell = torch.multinomial(free, robots, generator=generator)
    position = torch.stack((cell // width, cell % width), -1)
    cells = torch.stack(torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij"))
    far = (cells - position[:, :, None, None]).abs().amax(1) > SENSED_CELLS
    return TensorDict({"grid": obstacles.to(torch.int8).masked_fill(far, UNKNOWN), "at": position})


def map_buffer(maps: list[Tensor], robots: int = 4, seed: int = 0) -> TensorDictReplayBuffer:
    """A replay buffer with an entry per map bool [H, W]; its samples have FPR and NET."""
    generator = torch.Generator().manual_seed(seed)
    height, width = (max(sizes) for sizes in zip(*(m.shape for m in maps), strict=True))
    padded = [pad(m, (0, width - m.shape[1], 0, height - m.shape[0]), value=True) for m in maps]
    data = torch.stack([partly_known(m, robots, generator) for m in padded])
    buffer = TensorDictReplayBuffer(
        storage=LazyTensorStorage(len(maps)),
        sampler=SamplerWithoutReplacement(shuffle=False),
        batch_size=len(maps),
        transform=Compose(
            FrontierReachability("grid", "at", out_key="fpr", normalize=None),
            CommunicationNeighbors("at", out_key="net", range_cells=RANGE_CELLS),
        ),
    )
    buffer.extend(data)
    return buffer


def table(grid: Tensor, position: Tensor, fpr: Tensor, net: Tensor) -> str:
    """A table of one team: known cells, frontiers by direction, and robots in range."""
    rows = []
    for robot, (row, column) in enumerate(position.tolist()):
        number = fpr[robot, :, 0]
        nearest = fpr[robot, number > 0, 1].min().item() if number.any() else float("nan")
        others = [str(j) for j in net[robot].nonzero().flatten().tolist() if j != robot]
        known = int((grid[robot] != UNKNOWN).sum())
        counts = [f"{int(n)}" if n else "." for n in number]
        rows.append(
            [
                str(robot),
                f"{row},{column}",
                str(known),
                *counts,
                f"{nearest:.1f}",
                " ".join(others) or "-",
            ]
        )
    header = ["robot", "cell", "known", *DIRECTIONS, "nearest", "in range"]
    return tables.text(header, rows)


def main(
    source: tyro.conf.Positional[Literal["pursuit", "files"]],
    paths: tyro.conf.Positional[tuple[Path, ...]] = (),
    steps: int = 20,
    seed: int = 0,
) -> None:
    """Print the frontiers around each robot, by the direction of the first move to them.

    Args:
        source: pursuit, or a data set of map files.
        paths: map files (.png, .pgm, .yaml, .map, .txt); none: three mazes from the package.
        steps: number of steps of random pursuers.
        seed: of pursuit, and of the robots' cells on map files.
    """
    require_integer("steps", steps, 1)
    require_integer("seed", seed, 0)
    torch.manual_seed(seed)
    if source == "pursuit":
        last = pursuit_env(seed).rollout(steps)[-1]["next", "pursuers"]
        print(f"pursuit after {steps} random steps")
        print(table(last["map"], last["position"], last["fpr"], last["net"]))
        return
    mazes = suite("maze-32")
    drawn, _ = mazes.generator(mazes.config)(
        seed, torch.arange(3), torch.zeros(3, dtype=torch.int64)
    )
    maps = [load_map(path) for path in paths] or list(drawn)
    sample = map_buffer(maps, seed=seed).sample()
    for index, team in zip(sample["index"].tolist(), sample, strict=True):
        print(paths[index] if paths else f"maze {index}")
        print(table(team["grid"], team["at"], team["fpr"], team["net"]))


if __name__ == "__main__":
    run_program(lambda: tyro.cli(main), lambda _: None)
