"""Fields of settings have the types that they declare, in memory and in files."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from typing import Literal

import pytest

from marl_explore.config.arena import ArenaConfig
from marl_explore.config.fields import check_types, read_fields
from marl_explore.config.run import RunConfig
from marl_explore.policies.networks import CNN, MLP, DeepSet
from marl_explore.robot import RobotSettings
from marl_explore.training.config import TrainConfig
from marl_explore.training.run_folder import RunRecord
from marl_explore.training.seeds import SweepRecord


@dataclass(frozen=True)
class Sample:
    number: int = 1
    share: float = 0.5
    flag: bool = True
    name: str | None = None
    kind: Literal["a", "b"] = "a"
    widths: tuple[int, ...] = (1, 2)

    def __post_init__(self):
        check_types(self)


@pytest.mark.parametrize(
    ("field", "value", "allowed"),
    [
        ("number", 1.0, "an integer"),
        ("number", True, "an integer"),
        ("number", "1", "an integer"),
        ("number", 2**63, "an integer of at most 64 bits"),
        ("share", "x", "a number"),
        ("share", math.nan, "a number, not NaN"),
        ("share", False, "a number"),
        ("flag", 1, "true or false"),
        ("name", 3, "text or None"),
        ("kind", "c", r"one of \('a', 'b'\)"),
        ("kind", ["a"], "one of"),
        ("widths", (1, 2.5), "a list, each entry an integer"),
        ("widths", 3, "a list"),
    ],
)
def test_a_value_of_another_type_is_refused(field, value, allowed):
    with pytest.raises(ValueError, match=rf"^{field}=.* is not allowed: it must be {allowed}"):
        Sample(**{field: value})
    with pytest.raises(ValueError, match=rf"^a.json: {field}=.* is not allowed"):
        read_fields(Sample, {field: value}, "a.json")


def test_settings_are_read_as_they_were_written():
    sample = Sample(number=2**63 - 1, share=math.inf, name="x", widths=())
    assert read_fields(Sample, json.loads(json.dumps(sample.__dict__)), "a.json") == sample
    config = TrainConfig(network=CNN(hidden=8), ablate=("net",), arena=ArenaConfig(height=7))
    assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "a.json must be an object"),
        ({"numbr": 1}, "a.json has an unknown field 'numbr'"),
        ({"arena": {"heigth": 1}}, "a.json, arena has an unknown field 'heigth'"),
        ({"arena": {"height": None}}, "a.json, arena: height=None"),
        ({"arena": 3}, "a.json: arena=3 is not allowed: it must be of type ArenaConfig"),
        ({"options": {"hidden": [0]}}, "a.json, options of mlp: hidden=0"),
        ({"options": None}, "a.json, options of mlp must be an object"),
        ({"network": ["mlp"]}, "a.json: network="),
        ({"episodes": 0}, "a.json: episodes=0"),
    ],
)
def test_errors_in_files_name_file_and_field(values, message):
    if isinstance(values, dict) and not {"numbr"} & values.keys():
        with pytest.raises(ValueError, match=message):
            TrainConfig.from_json(TrainConfig().to_json() | values, "a.json")
    else:
        with pytest.raises(ValueError, match=message):
            read_fields(Sample, values, "a.json")


def test_missing_fields_are_named():
    with pytest.raises(ValueError, match="run.json has no field 'execution'"):
        read_fields(RunRecord, {}, "run.json")


@pytest.mark.parametrize(
    "make",
    [
        lambda: ArenaConfig(cell_size="1"),
        lambda: ArenaConfig(sensing_range=1e308, cell_size=1e-308),
        lambda: RunConfig(threads=10**6),
        lambda: RunConfig(logger=None),
        lambda: MLP(hidden=[16]),
        lambda: DeepSet(communicate_every="3"),
        lambda: RobotSettings(max_pose_age="x"),
        lambda: SweepRecord(()),
        lambda: SweepRecord((1, 1)),
        lambda: SweepRecord((-1,)),
        lambda: replace(TrainConfig(), actor_lr=math.inf),
        lambda: replace(TrainConfig(), clip_epsilon=1.0),
        lambda: replace(TrainConfig(), entropy_coeff=math.inf),
    ],
)
def test_settings_of_every_kind_refuse_what_they_cannot_be(make):
    with pytest.raises(ValueError, match="is not allowed: "):
        make()
