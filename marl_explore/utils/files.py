"""Atomic file writes: a file is complete or does not exist."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

UNFINISHED = ".unfinished"
"""Suffix of a file that is being written, or whose writer was killed."""


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """A temporary path to write to; it replaces ``path`` if no error occurs.

    Raises:
        OSError: naming ``path``, when it cannot be written; an earlier file is kept.
    """
    unfinished = path.with_name(path.name + UNFINISHED)
    try:
        with naming(path):
            yield unfinished
            with unfinished.open("rb") as file:
                os.fsync(file.fileno())  # before renaming, or a power cut could leave it empty
            os.replace(unfinished, path)
    finally:
        with suppress(OSError):  # the folder is gone or read-only, which was said above
            unfinished.unlink(missing_ok=True)


@contextmanager
def naming(path: Path) -> Iterator[None]:
    """Make the operating system's errors name this file; those of a full disk name none.

    Raises:
        OSError: of the same kind.
    """
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def file_digest(path: Path) -> str:
    """SHA-256 of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    with atomic_write(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")
