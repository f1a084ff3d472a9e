"""Checkpoints as files: what went in comes out, and every damage is one clear error."""

from __future__ import annotations

import json
import random

import pytest
import torch
from safetensors.torch import save_file

from marl_explore.training.checkpoint import (
    CheckpointError,
    list_checkpoints,
    read_checkpoint,
    write_checkpoint,
)

WEIGHTS = torch.arange(6.0).reshape(2, 3)
STATE = {
    "optimizer": {0: {"step": torch.tensor(3.0), "exp_avg": WEIGHTS.T}, 1: {}},
    "transposed": WEIGHTS.T,
    "shared": [WEIGHTS, WEIGHTS[0]],
    "mask": torch.tensor([True, False]),
    "random": torch.arange(5, dtype=torch.uint8),
    "none": None,
    "numbers": [1, 0.1, -1e-300, float("inf"), True],
    "text": "update",
}


@pytest.fixture
def path(tmp_path):
    return write_checkpoint(tmp_path, 7, STATE, keep=2)


def test_what_was_written_is_read(path):
    state = read_checkpoint(path)
    assert list(state) == list(STATE)
    assert list(state["optimizer"]) == [0, 1]  # keys stay integers
    assert torch.equal(state["optimizer"][0]["exp_avg"], WEIGHTS.T)
    assert state["optimizer"][0]["step"].shape == ()
    assert torch.equal(state["shared"][1], WEIGHTS[0])
    for key in ("mask", "random"):
        assert torch.equal(state[key], STATE[key])
        assert state[key].dtype == STATE[key].dtype
    assert [state[key] for key in ("none", "numbers", "text")] == [
        STATE[key] for key in ("none", "numbers", "text")
    ]
    assert state["numbers"][4] is True


def test_only_the_newest_are_kept(tmp_path):
    for update in (1, 2, 10):
        write_checkpoint(tmp_path, update, STATE, keep=2)
    names = ["update-00000002.safetensors", "update-00000010.safetensors"]
    assert [file.name for file in list_checkpoints(tmp_path)] == names
    assert [file.name for file in sorted((tmp_path / "checkpoints").iterdir())] == names


def test_what_a_killed_writer_left_is_no_checkpoint_and_is_cleared_away(tmp_path):
    write_checkpoint(tmp_path, 1, STATE, keep=2)
    left = tmp_path / "checkpoints" / "update-00000002.safetensors.unfinished"
    left.write_bytes(b"half")
    assert len(list_checkpoints(tmp_path)) == 1
    write_checkpoint(tmp_path, 3, STATE, keep=2)
    assert not left.exists()


def test_a_failed_write_leaves_the_older_ones_alone(tmp_path):
    write_checkpoint(tmp_path, 1, STATE, keep=1)
    with pytest.raises(TypeError, match="a checkpoint cannot hold /policy of type object"):
        write_checkpoint(tmp_path, 2, {"policy": object()}, keep=1)
    assert [file.name for file in list_checkpoints(tmp_path)] == ["update-00000001.safetensors"]


def test_every_flipped_bit_is_noticed(path):
    whole = path.read_bytes()
    for position in random.Random(0).sample(range(len(whole)), 300):
        damaged = bytearray(whole)
        damaged[position] ^= 1 << (position % 8)
        path.write_bytes(damaged)
        with pytest.raises(CheckpointError, match=path.name):
            read_checkpoint(path)


def test_every_truncation_is_noticed(path):
    whole = path.read_bytes()
    for length in range(0, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(CheckpointError, match=f"{path.name} is not a readable checkpoint"):
            read_checkpoint(path)


def test_foreign_files_are_refused(path):
    save_file({"weights": WEIGHTS}, path, {"format": "pt"})
    with pytest.raises(CheckpointError, match=r"its format is 'pt', expected 'marl_explore"):
        read_checkpoint(path)
    with pytest.raises(CheckpointError, match=r"none\.safetensors is not a readable checkpoint"):
        read_checkpoint(path.with_name("none.safetensors"))
    path.write_bytes(b"\x80\x04\x95" + json.dumps({}).encode())  # a pickle is never opened
    with pytest.raises(CheckpointError, match="is not a readable checkpoint"):
        read_checkpoint(path)
