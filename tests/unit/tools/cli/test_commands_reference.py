"""docs/reference/commands.md is what ``make options`` makes of the help of every command and option."""

import re

from gateway.tools.cli.main import EXIT_STATUSES
from tests.support.commands_page import PAGE, program_commands, update

REFERENCE = PAGE.read_text(encoding="utf-8")
COMMANDS = program_commands()


def test_reference_has_the_help_of_all_commands() -> None:
    """Options would otherwise be described twice, and differently."""
    assert update(REFERENCE, COMMANDS) == REFERENCE, "run make options"


def test_reference_has_exactly_the_commands_of_the_program() -> None:
    assert set(re.findall(r"^## (rtc3d-gateway .*)$", REFERENCE, re.MULTILINE)) == COMMANDS.keys()


def test_reference_has_every_exit_status() -> None:
    documented = set(re.findall(r"^\| (\d) \| ", REFERENCE, re.MULTILINE))
    assert documented == {"0", "1", "2"} | {str(status) for status in EXIT_STATUSES.values()}
