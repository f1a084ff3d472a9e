"""Checkpoints: the whole state of a run in one file, written atomically, read without running code.

A checkpoint is a safetensors file. Its metadata hold the structure of the state and everything in
it that is not a tensor as JSON, and a SHA-256 of all contents, so that any damage is detected.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from marl_explore.utils.files import UNFINISHED, naming
from marl_explore.utils.json_files import parse_object
from marl_explore.utils.tensor_files import read_tensors, write_tensors

FORMAT = "marl_explore.checkpoint/1"
FOLDER = "checkpoints"
_PATTERN = "update-*.safetensors"
_ABANDONED = ".abandoned"


class CheckpointError(ValueError):
    """A run cannot be resumed from a file; the message names the file and says what is wrong."""


def write_checkpoint(folder: Path, update: int, state: Mapping[str, Any], keep: int) -> Path:
    """Write the state after an update, then remove all but the newest checkpoints.

    Unfinished files of a killed writer, and checkpoints that were set aside, are removed too.

    Args:
        folder: of the run; the file goes into ``checkpoints/``.
        update: number of updates done.
        state: nested dicts, lists and tuples (which become lists) of tensors, numbers, strings,
            booleans and None; keys are strings or integers.
        keep: how many checkpoints to keep, at least 1.
    """
    path = folder / FOLDER / f"update-{update:08d}.safetensors"
    with naming(path.parent):
        path.parent.mkdir(exist_ok=True)
    tensors: dict[str, Tensor] = {}
    structure = json.dumps(_take_tensors(state, tensors))
    write_tensors(path, FORMAT, {"structure": structure}, tensors)
    for ending in (UNFINISHED, _ABANDONED):
        for left in path.parent.glob(f"{_PATTERN}{ending}"):
            left.unlink()
    for old in list_checkpoints(folder)[:-keep]:
        old.unlink()
    return path


def set_aside(path: Path) -> None:
    """Ignore a checkpoint from now on; it is removed when the next one is written."""
    path.rename(path.with_name(path.name + _ABANDONED))


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    return sorted((folder / FOLDER).glob(_PATTERN))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint.

    Raises:
        CheckpointError: when the file is not a checkpoint, or is truncated or damaged.
    """
    texts, tensors = read_tensors(path, (FORMAT,), "checkpoint", error=CheckpointError)
    try:
        structure = parse_object(texts.get("structure", ""), str(path))
    except ValueError as error:
        raise CheckpointError(str(error)) from error
    return cast(dict[str, Any], _put_tensors(structure, tensors))


def _take_tensors(value: Any, tensors: dict[str, Tensor], path: str = "") -> Any:
    """A value as JSON, with its tensors moved out; a dict becomes {"dict": pairs}."""
    if isinstance(value, Tensor):
        # a copy: entries of a state may share memory, which safetensors refuses
        tensors[path] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {"tensor": path}
    if isinstance(value, Mapping):
        return {"dict": [[k, _take_tensors(v, tensors, f"{path}/{k}")] for k, v in value.items()]}
    if isinstance(value, (list, tuple)):
        return [_take_tensors(v, tensors, f"{path}/{i}") for i, v in enumerate(value)]
    if value is None or isinstance(value, (bool, int, float, str)):
        return value
    raise TypeError(f"a checkpoint cannot hold {path} of type {type(value).__name__}")


def _put_tensors(value: Any, tensors: Mapping[str, Tensor]) -> Any:
    if isinstance(value, list):
        return [_put_tensors(entry, tensors) for entry in value]
    if isinstance(value, dict) and "tensor" in value:
        return tensors[value["tensor"]]
    if isinstance(value, dict):
        return {key: _put_tensors(entry, tensors) for key, entry in value["dict"]}
    return value
