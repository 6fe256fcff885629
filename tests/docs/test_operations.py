"""docs/operations.md lists every message of level WARNING and above, and no others."""

import re
from pathlib import Path

from tests.log_messages import message_patterns

ROOT = Path(__file__).parents[2]
OPERATIONS = (ROOT / "docs/operations.md").read_text()
TEST_OUTPUT = "outputs/memory.py"


def documented_messages() -> list[str]:
    """Return the messages in the tables; a row may have several."""
    cells = re.findall(r"^\| (`.*?`) \| (?:WARNING|ERROR) \|", OPERATIONS, re.MULTILINE)
    return [message for cell in cells for message in re.findall("`(.+?)`(?:; |$)", cell)]


def patterns() -> dict[str, str]:
    found = message_patterns(ROOT / "gateway")
    return {pattern: origin for pattern, origin in found.items() if not origin.startswith(TEST_OUTPUT)}


def test_every_message_is_documented() -> None:
    missing = {
        origin: pattern
        for pattern, origin in patterns().items()
        if not any(re.search(pattern, message) for message in documented_messages())
    }
    assert not missing, "docs/operations.md does not have these messages"


def test_every_documented_message_exists() -> None:
    known = patterns()
    gone = [
        message for message in documented_messages() if not any(re.search(each, message) for each in known)
    ]
    assert not gone, "docs/operations.md has messages that gateway/ does not log"


def test_messages_are_found() -> None:
    assert len(patterns()) > 40
    assert len(documented_messages()) > 40
