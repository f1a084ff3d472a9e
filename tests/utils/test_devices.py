"""Devices by name; what runs on others than the CPU is not tested."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from tensordict.nn import TensorDictModuleBase

from marl_explore import ArenaConfig, TrainConfig
from marl_explore.arenas import suite
from marl_explore.cli.main import main
from marl_explore.config.run import RunConfig
from marl_explore.evaluation.episodes import record
from marl_explore.evaluation.leaderboard.cells import Cell, read, write
from marl_explore.evaluation.outside import TeamPolicy
from marl_explore.planners.random import RandomWalk
from marl_explore.training import validation
from marl_explore.training.trainer import Trainer
from marl_explore.utils.devices import find_device


class Stays(TensorDictModuleBase):
    """A module of another package, with a weight."""

    def __init__(self):
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))


NONE = {
    "tpu": "it must be cpu, cuda, or cuda:1, ...",
    "cuda:": "it must be cpu, cuda, or cuda:1, ...",
    "cpu:0": "it must be cpu, cuda, or cuda:1, ...",
    "meta": "it must be cpu, cuda, or cuda:1, ...",
    "cuda:200": "torch finds .* CUDA devices here",
}


@pytest.mark.parametrize(("name", "allowed"), NONE.items())
def test_devices_that_there_are_not_are_refused_by_name(name, allowed):
    for use in (
        find_device,
        lambda device: Trainer(TrainConfig(episodes=8), RunConfig(device=device)),
        lambda device: record(RandomWalk(), ArenaConfig(), 1, 1, device=device),
    ):
        with pytest.raises(ValueError, match=f"device='{name}' is not allowed: {allowed}"):
            use(name)


def test_the_cpu_is_a_device():
    assert find_device("cpu") == torch.device("cpu")


def test_workers_collect_on_the_cpu():
    with pytest.raises(ValueError, match="device='cuda' is not allowed with collector='multisync'"):
        RunConfig(collector="multisync", workers=2, device="cuda")


@pytest.mark.parametrize("command", [("evaluate", "random"), ("leaderboard", "random")])
def test_commands_refuse_a_device_before_they_begin(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit, match="device='cuda:200' is not allowed"):
        main([*command, "--device", "cuda:200"])
    assert not any(tmp_path.rglob("*.json"))


def test_a_run_is_validated_where_it_computes(tmp_path, monkeypatch):
    asked = []
    measures = {"steps_to_100": 1.0, "final_largest_coverage": 1.0}
    monkeypatch.setattr(
        validation, "evaluate", lambda *_, **options: asked.append(options["device"]) or measures
    )
    config = TrainConfig(episodes=8)
    policy = Trainer(config).policy
    validation.Validation(config, RunConfig(device="cuda:1"), tmp_path)(policy, 1)
    assert asked == ["cuda:1"]


def test_a_cell_of_another_device_is_another_one(tmp_path):
    cell = Cell("random", suite("paper-12"), num_arenas=1, steps=1, seed=0)
    there = replace(cell, device="cuda")
    for made, wanted in ((cell, there), (there, cell)):
        path = tmp_path / made.device
        write(path, {"settings": made.settings})
        assert read(path, made) is not None
        with pytest.raises(ValueError, match=f"device was .* and now is '{wanted.device}'"):
            read(path, wanted)


def test_modules_of_other_packages_move_too():
    policy = TeamPolicy("pkg:module", Stays(), ArenaConfig())
    assert policy.to(torch.device("meta"))._act.weight.device.type == "meta"
