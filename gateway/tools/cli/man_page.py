"""Prints the man page, made from the help of all commands: ``python -m gateway.tools.cli.man_page``.

``make install`` runs it, so that the page is that of the installed program.
"""

import re
from collections.abc import Iterator
from enum import Enum
from typing import Any, Final

import typer
import typer.core

from gateway.config.document import VARIABLE_PREFIX
from gateway.config.files import DEFAULT_CONFIG
from gateway.tools.cli.main import EXIT_STATUSES, app

_PROGRAM: Final = "rtc3d-gateway"

_STATUSES: Final = {
    0: "success",
    1: "failure",
    2: "the command line or the configuration is invalid",
    **{
        status: f"commands that ask gateways: {code.replace('-', ' ')}"
        for code, status in EXIT_STATUSES.items()
    },
    130: "Ctrl-C or SIGTERM before the command was complete",
}


def man_page() -> str:
    """Return the page in the language of troff (man(7))."""
    group: Any = typer.main.get_command(app)
    lines = [
        f".TH {_PROGRAM.upper()} 1",
        ".SH NAME",
        f"{_PROGRAM} \\- {_text(group.help[0].lower() + group.help[1:].removesuffix('.'))}",
        ".SH SYNOPSIS",
        f"\\fB{_PROGRAM}\\fR [\\fIOPTIONS\\fR] \\fICOMMAND\\fR [\\fIARGUMENTS\\fR]",
        ".SH OPTIONS",
        *_parameters(group.params),
        *_entry("\\fB\\-h\\fR, \\fB\\-\\-help\\fR", "Show the help of the program, or of a command."),
        ".SH COMMANDS",
    ]
    for name, command in commands(group):
        arguments = [f"\\fI{_text(value_word(each))}\\fR" for each in command.params if not is_option(each)]
        lines.append(" ".join([".SS", _text(name), "[\\fIOPTIONS\\fR]", *arguments]))
        for number, paragraph in enumerate((command.help or "").split("\n\n")):
            lines += [".PP"] * (number > 0) + [_text(" ".join(paragraph.split()))]
        lines += _parameters(command.params)
    lines.append(".SH EXIT STATUS")
    for status, meaning in _STATUSES.items():
        lines += _entry(f"\\fB{status}\\fR", meaning)
    lines.append(".SH ENVIRONMENT")
    lines += _entry(
        f"\\fB{VARIABLE_PREFIX}\\fISECTION\\fB__\\fIKEY\\fR",
        f"A value that overrides the configuration file; {VARIABLE_PREFIX}LCM__URL is lcm.url.",
    )
    lines.append(".SH FILES")
    lines += _entry(
        f"\\fI{_text(str(DEFAULT_CONFIG))}\\fR",
        "The configuration of the service, and of commands that are given none.",
    )
    return "\n".join(lines) + "\n"


def commands(group: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every command that is not a group, with its name."""
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        if isinstance(command, typer.core.TyperGroup):
            yield from commands(command, f"{prefix}{name} ")
        else:
            yield f"{prefix}{name}", command


def is_option(parameter: Any) -> bool:
    """Return False for an argument."""
    return isinstance(parameter, typer.core.TyperOption)


def value_word(parameter: Any) -> str:
    """Return the word for the value of an option or an argument, such as SECONDS."""
    longest = max(parameter.opts, key=len).strip("-")
    return str(parameter.metavar or longest.upper().replace("_", "-"))


def help_text(parameter: Any) -> str:
    """Return the help of an option or an argument, with its default."""
    text = str(parameter.help or "")
    default = parameter.default
    if default is None or isinstance(default, bool):
        return text
    shown = default.value if isinstance(default, Enum) else default
    return (
        f"{text} The default is {shown:g}." if isinstance(shown, float) else f"{text} The default is {shown}."
    )


def _parameters(parameters: list[Any]) -> list[str]:
    lines = []
    for parameter in parameters:
        if getattr(parameter, "hidden", False):
            continue
        title = f"\\fI{_text(value_word(parameter))}\\fR"
        if is_option(parameter):
            names = ", ".join(f"\\fB{_text(name)}\\fR" for name in sorted(parameter.opts, key=len))
            title = names if parameter.is_flag else f"{names} {title}"
        lines += _entry(title, help_text(parameter))
    return lines


def _entry(title: str, text: str) -> list[str]:
    return [".TP", title, _text(text)]


def _text(text: str) -> str:
    """Return text as troff takes it: backslashes, hyphens, and dots at the beginning have a meaning."""
    text = text.replace("\\", "\\e").replace("-", "\\-")
    text = re.sub(r"^(?=[.'])", r"\\&", text)
    return re.sub(r"[^\x00-\x7f]", lambda found: f"\\[u{ord(found[0]):04X}]", text)


if __name__ == "__main__":
    print(man_page(), end="")
