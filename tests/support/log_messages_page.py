"""Writes the messages of the source code into docs/reference/log-messages.md: ``make messages``.

People write only the last column of its tables, the advice, and decide which messages share a row. The
other columns come from the source code. If a sentence changes there, its row gets the new one and keeps its
advice.
"""

import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from difflib import SequenceMatcher
from typing import Final

from tests.support.documents import ROOT
from tests.support.log_messages import Message, messages

PAGE: Final = ROOT / "docs/reference/log-messages.md"

_ROW: Final = re.compile(r"\| (`.*`) \| (?:WARNING|ERROR) \|(.*)\|")
_SEPARATOR: Final = "`; `"
_SAME_SENTENCE: Final = 0.6
"""Two texts that are less alike (0 to 1) are two messages, and not two wordings of one."""


@dataclass
class _Row:
    """A row of a table. ``advice`` says what to do about its messages."""

    texts: list[str]
    advice: str = ""

    def line(self, known: dict[str, Message]) -> str:
        level = "ERROR" if any(known[text].level == "ERROR" for text in self.texts) else "WARNING"
        return f"| `{_SEPARATOR.join(self.texts)}` | {level} | {self.advice} |"


@dataclass
class Update:
    """The page as it should be, and what a person has to add."""

    page: str
    without_advice: list[str] = field(default_factory=list)


def update(page: str, in_source: Sequence[Message]) -> Update:
    """Return ``page`` with the messages of the source code in its tables."""
    known = {_shown(message.text): message for message in in_source}
    lines = [_row_of(line) or line for line in page.splitlines()]
    rows = [line for line in lines if isinstance(line, _Row)]
    listed = {text for row in rows for text in row.texts}
    new = [text for text in known if text not in listed]
    for old, replacement in _rewordings([text for text in listed if text not in known], new):
        new.remove(replacement)
        for row in rows:
            row.texts = [replacement if text == old else text for text in row.texts]
    for row in rows:
        row.texts = [text for text in row.texts if text in known]
    for text in new:
        lines.insert(_place_of(known[text], lines, known), _Row([text]))
    remaining = [line for line in lines if not isinstance(line, _Row) or line.texts]
    written = (line.line(known) if isinstance(line, _Row) else line for line in remaining)
    without_advice = [
        f"{known[text].place}: {text}"
        for row in remaining
        if isinstance(row, _Row) and not row.advice
        for text in row.texts
    ]
    return Update("\n".join(written) + "\n", without_advice)


def _shown(text: str) -> str:
    """Return a text as it stands in a cell, between backticks."""
    return text.replace("`", "'").replace("|", "or")


def _row_of(line: str) -> _Row | None:
    match = _ROW.fullmatch(line)
    return match and _Row(match[1][1:-1].split(_SEPARATOR), match[2].strip())


def _rewordings(old: Sequence[str], new: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield pairs of an old and a new wording of one message, the most similar ones first."""
    pairs = sorted(
        ((SequenceMatcher(None, before, after).ratio(), before, after) for before in old for after in new),
        reverse=True,
    )
    seen: set[str] = set()
    for similarity, before, after in pairs:
        if similarity >= _SAME_SENTENCE and not {before, after} & seen:
            seen |= {before, after}
            yield before, after


def _place_of(message: Message, lines: Sequence[_Row | str], known: dict[str, Message]) -> int:
    """Return where to insert a row: after the last one with a message of the same or a near module."""
    path = message.place.partition(":")[0].split("/")

    def nearness(row: _Row) -> int:
        places = (known[text].place.partition(":")[0].split("/") for text in row.texts)
        return max((_num_common(path, place) for place in places), default=0)

    return 1 + max(
        (index for index, line in enumerate(lines) if isinstance(line, _Row)),
        key=lambda index: (nearness(lines[index]), index),  # type: ignore[arg-type]  # only rows
    )


def _num_common(one: Sequence[str], other: Sequence[str]) -> int:
    """Return the number of equal parts at the beginning."""
    unequal = (i for i, (part, other_part) in enumerate(zip(one, other, strict=False)) if part != other_part)
    return next(unequal, min(len(one), len(other)))


def main() -> int:
    """Write the page; name the messages that have no advice yet."""
    result = update(PAGE.read_text(), messages(ROOT / "gateway"))
    PAGE.write_text(result.page)
    for message in result.without_advice:
        print(f"{PAGE.name} has no advice for {message}")
    return 1 if result.without_advice else 0


if __name__ == "__main__":
    sys.exit(main())
