"""Checkpoints: the whole state of a run in one file, written whole, read without running code.

A file is safetensors. Its metadata hold the structure of the state and everything in it that is
no tensor as JSON, and a SHA-256 of both, so that damage anywhere is noticed.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from marl_explore.files import UNFINISHED, whole_file

FORMAT = "marl_explore.checkpoint/1"
FOLDER = "checkpoints"
_PATTERN = "update-*.safetensors"
_ABANDONED = ".abandoned"


class CheckpointError(ValueError):
    """A file that cannot be gone on from; the message names it and what is wrong."""


def write_checkpoint(folder: Path, update: int, state: Mapping[str, Any], keep: int) -> Path:
    """Write the state after an update, then remove all but the newest checkpoints.

    Files that a killed writer left, and checkpoints that were set aside, are removed too.

    Args:
        folder: of the run; the file goes into ``checkpoints/``.
        update: updates done.
        state: nested dicts, lists and tuples (which become lists) of tensors, numbers, strings,
            booleans and None; keys are strings or integers.
        keep: how many checkpoints to leave, at least 1.
    """
    path = folder / FOLDER / f"update-{update:08d}.safetensors"
    path.parent.mkdir(exist_ok=True)
    tensors: dict[str, Tensor] = {}
    structure = json.dumps(_take_tensors(state, tensors))
    metadata = {"format": FORMAT, "structure": structure, "sha256": _digest(structure, tensors)}
    with whole_file(path) as unfinished:
        save_file(tensors, unfinished, metadata)
    for ending in (UNFINISHED, _ABANDONED):
        for left in path.parent.glob(f"{_PATTERN}{ending}"):
            left.unlink()
    for old in list_checkpoints(folder)[:-keep]:
        old.unlink()
    return path


def set_aside(path: Path) -> None:
    """Let a checkpoint count no longer; the next one that is written removes it."""
    path.rename(path.with_name(path.name + _ABANDONED))


def list_checkpoints(folder: Path) -> list[Path]:
    """The checkpoints of a run, oldest first."""
    return sorted((folder / FOLDER).glob(_PATTERN))


def read_checkpoint(path: Path) -> dict[str, Any]:
    """The state in a checkpoint.

    Raises:
        CheckpointError: when the file is no checkpoint, cut off, or damaged.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} is not a readable checkpoint: {error}") from error
    if metadata.get("format") != FORMAT:
        raise CheckpointError(
            f"{path} is not a checkpoint of this package: its format is "
            f"{metadata.get('format')!r}, expected {FORMAT!r}"
        )
    structure = metadata.get("structure", "")
    if _digest(structure, tensors) != metadata.get("sha256"):
        raise CheckpointError(f"{path} is damaged: its contents do not have the SHA-256 in it")
    return _put_tensors(json.loads(structure), tensors)


def _digest(structure: str, tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256(structure.encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()


def _take_tensors(value: Any, tensors: dict[str, Tensor], path: str = "") -> Any:
    """The JSON of a value, its tensors moved out: a dict is {"dict": pairs}, a list itself."""
    if isinstance(value, Tensor):
        # a copy: entries of a state may share memory, those of a file do not
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
