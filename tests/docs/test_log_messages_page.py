"""The tool that writes the messages of the source code into docs/reference/log-messages.md."""

from pathlib import Path

import pytest

from tests.support.log_messages import Message, messages
from tests.support.log_messages_page import update

HEAD = "## Server\n\n| message | level | what to do |\n|---|---|---|\n"
PAGE = (
    f"{HEAD}"
    "| `no answer from <server>; is it on?` | WARNING | Switch it on. |\n"
    "| `<file> is lost`; `<file> is not stored` | ERROR | Save it by hand. |\n"
)
NO_ANSWER = Message("no answer from <server>; is it on?", "WARNING", "session/tcp.py:12")
LOST = Message("<file> is lost", "ERROR", "spool.py:4")
NOT_STORED = Message("<file> is not stored", "ERROR", "spool.py:9")


def found_in(tmp_path: Path, source: str) -> dict[str, str]:
    """Return the level of each message in a program."""
    (tmp_path / "module.py").write_text(source)
    return {message.text: message.level for message in messages(tmp_path)}


def test_a_page_that_is_up_to_date_stays_as_it_is() -> None:
    result = update(PAGE, [NO_ANSWER, LOST, NOT_STORED])
    assert (result.page, result.without_advice) == (PAGE, [])


def test_a_sentence_that_changes_keeps_its_advice_and_its_row() -> None:
    """To better a sentence is one edit in the source code and ``make messages``."""
    better = Message("no answer from <server> within <timeout> s; is it on?", "WARNING", "session/tcp.py:12")
    result = update(PAGE, [better, LOST, NOT_STORED])
    assert result.page == PAGE.replace(NO_ANSWER.text, better.text)
    assert result.without_advice == []


def test_a_level_that_changes_is_written() -> None:
    result = update(PAGE, [Message(NO_ANSWER.text, "ERROR", NO_ANSWER.place), LOST, NOT_STORED])
    assert "is it on?` | ERROR | Switch it on. |" in result.page


def test_a_message_that_is_gone_leaves_its_row_and_an_empty_row_is_removed() -> None:
    assert update(PAGE, [LOST]).page == HEAD + "| `<file> is lost` | ERROR | Save it by hand. |\n"


def test_a_new_message_gets_a_row_beside_those_of_its_module_and_is_named() -> None:
    new = Message("<host> has another address", "WARNING", "session/tcp.py:40")
    result = update(PAGE, [NO_ANSWER, new, LOST, NOT_STORED])
    assert result.page.splitlines()[5] == "| `<host> has another address` | WARNING |  |"
    assert result.without_advice == ["session/tcp.py:40: <host> has another address"]
    assert update(result.page, [NO_ANSWER, new, LOST, NOT_STORED]).without_advice == result.without_advice


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ('def f(peer): logger.warning("no answer from %s", peer)', {"no answer from <peer>": "WARNING"}),
        ('def f(self): self._log.error(f"{self.peer!r} is lost")', {"'<peer>' is lost": "ERROR"}),
        ('def f(a): logger.info("%s is there now", a)', {}),
        (
            'def f(max_files): raise SpoolError(f"more than {max_files} files")',
            {"more than <limit> files": "ERROR"},
        ),
        (
            'def f(a):\n text = "is it on?" if a else "is it near?"\n logger.warning(f"lost: {text}")',
            {"lost: is it on?": "WARNING", "lost: is it near?": "WARNING"},
        ),
        (
            'def f(text): logger.warning(f"{text}; try again")\ndef g(peer): f(f"no answer from {peer}")',
            {"no answer from <peer>; try again": "WARNING"},
        ),
        (
            'class LongName:\n def f(self): logger.warning("%s is closed", self)',
            {"<long name> is closed": "WARNING"},
        ),
    ],
)
def test_messages_are_found_with_placeholders_named_after_expressions(
    tmp_path: Path, source: str, expected: dict[str, str]
) -> None:
    assert found_in(tmp_path, source) == expected
