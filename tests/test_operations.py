"""docs/operations.md has every message that needs somebody, and no other."""

import re
from pathlib import Path

from tests.log_messages import told_patterns

ROOT = Path(__file__).parents[1]
OPERATIONS = (ROOT / "docs/operations.md").read_text()
FOR_TESTS = "outputs/memory_output.py"


def documented() -> list[str]:
    """Return the messages in the tables; a row may have several."""
    cells = re.findall(r"^\| (`.*?`) \| (?:WARNING|ERROR) \|", OPERATIONS, re.MULTILINE)
    return [message for cell in cells for message in re.findall("`(.+?)`(?:; |$)", cell)]


def patterns() -> dict[str, str]:
    found = told_patterns(ROOT / "gateway")
    return {pattern: place for pattern, place in found.items() if not place.startswith(FOR_TESTS)}


def test_every_message_is_in_the_tables() -> None:
    missing = {
        place: pattern
        for pattern, place in patterns().items()
        if not any(re.search(pattern, message) for message in documented())
    }
    assert not missing, "docs/operations.md says nothing of these messages"


def test_every_message_in_the_tables_can_come() -> None:
    known = patterns()
    gone = [message for message in documented() if not any(re.search(each, message) for each in known)]
    assert not gone, "docs/operations.md has messages that nothing in gateway/ says"


def test_there_are_messages_to_check() -> None:
    assert len(patterns()) > 40
    assert len(documented()) > 40
