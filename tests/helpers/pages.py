"""The fenced blocks of README and docs/."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from textwrap import dedent
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    str(path.relative_to(ROOT))
    for path in (ROOT / "README.md", *(ROOT / "docs").rglob("*.md"))
    if "_build" not in path.parts
)
NEEDS = re.compile(r"^# needs: (\S.{3,})$", re.MULTILINE)
"""What a reader sees in a block that does not run by itself, and why it is not run here."""
_FENCED = re.compile(r"^( *)```([^\n`]*)\n(.*?)^\1```$", re.DOTALL | re.MULTILINE)


class Block(NamedTuple):
    """A fenced block."""

    page: str
    kind: str
    """Language, directive of the site, or nothing for text."""
    code: str

    @property
    def needs(self) -> str | None:
        """What it needs, if it says so."""
        found = NEEDS.search(self.code)
        return found[1] if found else None


def read(page: str, text: str) -> list[Block]:
    """All blocks of a page."""
    return [Block(page, kind, dedent(code)) for _, kind, code in _FENCED.findall(text)]


def blocks(kind: str) -> list[Block]:
    """The blocks of one kind on all pages."""
    return [b for page in PAGES for b in read(page, (ROOT / page).read_text()) if b.kind == kind]


def commands(script: str) -> list[list[str]]:
    """The words of every command of a shell block, without comments."""
    lines = script.replace("\\\n", " ").splitlines()
    words = [shlex.split(part, comments=True) for line in lines for part in line.split("&&")]
    return [line[1:] if line[0] == "exec" else line for line in words if line]
