"""The examples of the README and of docs/ run as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
BLOCKS = [
    (page, block)
    for page in ("README.md", "docs/replay.md", "docs/planners.md")
    for block in re.findall(r"```python\n(.*?)```", (ROOT / page).read_text(), re.DOTALL)
    if "..." not in block
]


def test_there_are_examples():
    assert {page for page, _ in BLOCKS} == {"README.md", "docs/replay.md", "docs/planners.md"}


@pytest.mark.parametrize(("page", "block"), BLOCKS, ids=range(len(BLOCKS)))
def test_example(page, block, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # examples may write files
    exec(compile(block, page, "exec"), {})
