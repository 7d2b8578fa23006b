"""Blocks of code on the pages of the documentation, and what a comment above them says of running them.

`<!-- run apart: WHY -->` above a block: it takes long or needs what a block before it wrote. `<!-- not run: WHY -->`:
never.
"""

import re
from dataclasses import dataclass
from pathlib import Path

from markdown_it import MarkdownIt

ROOT = Path(__file__).resolve().parents[2]
_MARK = re.compile(r"<!-- (run apart|not run): (.{5,}) -->")


@dataclass(frozen=True)
class Block:
    """A block of code, from the line (from 1) of its page."""

    page: str
    line: int
    language: str
    code: str
    mark: str | None  # `run apart`, `not run`, or None: run in the usual tests

    @property
    def place(self) -> str:
        """Where it stands, for messages."""
        return f"{self.page}:{self.line}"


def pages() -> list[str]:
    """All pages that are written by hand, from the root of the repository; tutorials first, in their order."""
    tutorials = [
        f"docs/tutorials/{name}.md" for name in ("first-procedure", "own-case", "own-similarity", "small-training")
    ]
    others = [
        *ROOT.glob("docs/**/*.md"),
        *ROOT.glob("*.md"),
        *ROOT.glob("*/README.md"),
        ROOT / "models/weights/README.md",
    ]
    return list(dict.fromkeys([*tutorials, *sorted(path.relative_to(ROOT).as_posix() for path in others)]))


def blocks_of(page: str) -> list[Block]:
    """All blocks of code of a page, those without a language included."""
    found, mark = [], None
    for token in MarkdownIt().parse((ROOT / page).read_text(encoding="utf-8")):
        if token.type in ("fence", "code_block"):
            assert token.map
            found.append(Block(page, token.map[0] + 1, token.info.strip(), token.content, mark))
        match = _MARK.fullmatch(token.content.strip()) if token.type == "html_block" else None
        mark = match[1] if match else None
    return found
