"""Reads this package's tensor files; the metadata of each file name its format."""

from __future__ import annotations

from pathlib import Path

from safetensors import SafetensorError, safe_open
from torch import Tensor


def read_tensors(
    path: Path, format: str, what: str, error: type[ValueError] = ValueError
) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Metadata and tensors of a safetensors file.

    Args:
        path: the file.
        format: name of the format that its metadata must have.
        what: kind of file, such as "policy", for error messages.
        error: type of the error that is raised.

    Raises:
        ValueError: of type ``error``, when it cannot be read or has another format.
    """
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as reason:
        raise error(f"{path} is not a readable {what} file: {reason}") from reason
    found = metadata.get("format")
    if found != format:
        raise error(
            f"{path} is not a {what} of this package: its format is {found!r}, expected {format!r}"
        )
    return metadata, tensors
