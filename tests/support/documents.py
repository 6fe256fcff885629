"""The documents of this repository and their fenced blocks."""

import re
from pathlib import Path
from typing import Final, NamedTuple

ROOT: Final = Path(__file__).parents[2]

_FENCED: Final = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)


class Block(NamedTuple):
    """A fenced block. Its title is a file name, or the terminal in which to type the commands."""

    document: str
    line: int
    language: str
    title: str
    text: str

    @property
    def place(self) -> str:
        return f"{self.document}:{self.line}"


def documents() -> list[str]:
    """Return the paths of all Markdown files, relative to the root of the repository."""
    folders = (ROOT.glob("*.md"), *(ROOT.glob(f"{name}/**/*.md") for name in ("docs", "config", "examples")))
    return sorted(str(path.relative_to(ROOT)) for paths in folders for path in paths)


def blocks(document: str, *languages: str) -> list[Block]:
    """Return the fenced blocks of a document in these languages, or in all languages."""
    text = (ROOT / document).read_text(encoding="utf-8")
    found = (
        Block(document, text.count("\n", 0, match.start()) + 1, match[1], match[2] or "", match[3])
        for match in _FENCED.finditer(text)
    )
    return [block for block in found if not languages or block.language in languages]


def all_blocks(*languages: str) -> list[Block]:
    """Return the fenced blocks of all documents in these languages."""
    return [block for document in documents() for block in blocks(document, *languages)]
