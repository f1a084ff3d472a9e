"""This package's tensor files: safetensors whose metadata name their format and their SHA-256."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from marl_explore.utils.files import atomic_write

_OWN = ("format", "sha256")
"""Metadata that every file has, apart from its kind's own texts."""


def write_tensors(
    path: Path, format: str, texts: Mapping[str, str], tensors: Mapping[str, Tensor]
) -> None:
    """Write a safetensors file atomically, with a SHA-256 of all that it holds.

    Args:
        path: the file.
        format: name of its format.
        texts: its metadata.
        tensors: by name.

    Raises:
        OSError: naming the file, when it cannot be written.
    """
    contents = {n: tensor.detach().cpu().contiguous() for n, tensor in tensors.items()}
    metadata = {"format": format, "sha256": _digest(texts, contents), **texts}
    with atomic_write(path) as unfinished:
        try:
            save_file(contents, unfinished, metadata)
        except SafetensorError as error:  # of a full disk, for one
            raise OSError(f"{path} cannot be written: {error}") from error


def read_tensors(
    path: Path,
    formats: tuple[str, ...],
    what: str,
    unsigned: tuple[str, ...] = (),
    error: type[ValueError] = ValueError,
) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Texts and tensors of a file that ``write_tensors`` wrote.

    Args:
        path: the file.
        formats: the formats that it may have.
        what: kind of file, such as "policy", for error messages.
        unsigned: those of the formats that had no SHA-256.
        error: type of the error that is raised.

    Raises:
        ValueError: of type ``error``, when it cannot be read, has another format, or its contents
            are not what was written.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError, RuntimeError) as reason:
        raise error(f"{path} is not a readable {what} file: {reason}") from reason
    found = metadata.get("format")
    if found not in formats:
        raise error(
            f"{path} is not a {what} of this package: its format is {found!r}, expected "
            f"{formats[0]!r}"
        )
    texts = {name: text for name, text in metadata.items() if name not in _OWN}
    if found not in unsigned and metadata.get("sha256") != _digest(texts, tensors):
        raise error(f"{path} is damaged: its contents do not match its SHA-256")
    return texts, tensors


def _digest(texts: Mapping[str, str], tensors: Mapping[str, Tensor]) -> str:
    digest = hashlib.sha256("\0".join(texts[name] for name in sorted(texts)).encode())
    for name in sorted(tensors):
        tensor = tensors[name]
        digest.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return digest.hexdigest()
