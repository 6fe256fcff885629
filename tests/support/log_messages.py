"""Finds the messages that the gateway can log at WARNING and above, in its source code.

The text of a message has placeholders named after the expressions in the source: ``f"no answer from {peer}"``
is ``no answer from <peer>``. tests/support/log_messages_page.py writes them into the page of log messages.
"""

import ast
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Final

from tests.support.source_texts import Sources, texts, with_values

_EVENT_LOGS: Final = {"events", "_events"}
"""Their second argument is the text."""

_LOGGERS: Final = {"logger", "_log", "_logger", *_EVENT_LOGS}
_DEFECT_LOGS: Final = {"defects", "_defects"}
"""Their second argument, if any, is a text that is logged as ERROR."""

_LOUD_METHODS: Final = {"warning", "error", "exception", "critical"}
"""Methods of loggers that log at WARNING and above; ``log`` can do so, too."""

_LOSS_METHODS: Final = {"lost", "message_lost", "_count_loss"}
"""Methods that log their second argument as WARNING, at least the first time; the first is a cause."""

_WARNING_METHODS: Final = {"failed", "add_limitation", "file_lost", *_LOSS_METHODS}
"""Methods that log their argument as WARNING, at least the first time."""

_LOGGED_CLASSES: Final = {
    *("LinkError", "ConnectError", "ReplyTimeoutError", "SilenceError", "ClosedError"),
    *("RequestError", "DefectError", "StreamPlan", "RateDifference"),
    *("PacketError", "OutputError", "OutputHealth", "SpoolError", "SessionTexts"),
    *("PortError", "PortOpener"),
}
"""Classes whose texts are logged as WARNING or ERROR."""

_ERROR_SOURCES: Final = {"error", "exception", "critical", "SpoolError", "DefectError"}
"""Methods that log at ERROR, and classes whose texts are."""

_KEYWORDS: Final = {"limitation", "not_open", "cannot_open", "no_router"}
"""The keywords of calls whose values are logged."""

_PROBLEMS: Final = {"problem", "disk_problem", "file_problem", "thread_problem", "take_lock"}
"""Functions that return, and attributes that have, a text that is logged as WARNING if it is news."""

_PRINTING_FOLDERS: Final = tuple(map(Path, ("client", "messages/foxglove", "tools/cli", "tools/doctor")))
"""Commands that print their errors instead of logging them, and what raises them."""

_PRINTING_MODULES: Final = {
    "checks.py",
    "tls_checks.py",
    "subscriber.py",
    "status_messages.py",
}
"""Modules that only commands use, and those whose texts are in messages to peers."""


@dataclass(frozen=True)
class Message:
    """A message in the source code. ``text`` has placeholders; ``place`` is the first one that logs it."""

    text: str
    level: str
    place: str


def messages(package: Path) -> list[Message]:
    """Return each message that can be logged at WARNING and above, in the order of the source code."""
    found: dict[str, Message] = {}
    modules = {path: _parsed(path) for path in sorted(package.rglob("*.py"))}
    sources = Sources(list(modules.values()))
    for path, module in modules.items():
        if any(path.is_relative_to(package / folder) for folder in _PRINTING_FOLDERS):
            continue
        if path.name in _PRINTING_MODULES:
            continue
        for scope in sources.scopes(module):
            for node in chain(_logging_calls(scope, sources), _problems(scope, sources)):
                for text in _texts_of(node, scope, module, sources):
                    new = Message(text, _level(node), f"{path.relative_to(package)}:{node.lineno}")
                    former = found.setdefault(text, new)
                    if new.level == "ERROR" != former.level:
                        found[text] = Message(text, new.level, former.place)
    return list(found.values())


def _parsed(path: Path) -> ast.Module:
    """Return a module in which ``self`` is named after its class."""
    module = ast.parse(path.read_text())
    for definition in ast.walk(module):
        if isinstance(definition, ast.ClassDef):
            words = re.sub("(?<!^)(?=[A-Z])", "_", definition.name.strip("_")).lower()
            for node in ast.walk(definition):
                if isinstance(node, ast.Name) and node.id == "self":
                    node.id = words
    return module


def _is_sentence(text: str) -> bool:
    words = re.sub("<[^<>]*>", "", text)
    return " " in words.strip() and re.search("[a-z]{3}", words) is not None and text.count("<…>") < 2


def _texts_of(node: ast.expr, scope: ast.AST, module: ast.Module, sources: Sources) -> Iterator[str]:
    """Yield the texts of a call that logs, or of a problem, with placeholders."""
    arguments: Sequence[ast.expr] = [node]
    keywords: list[ast.expr] = []
    if isinstance(node, ast.Call) and _is_loud(node):
        arguments = _arguments(node)
        keywords = [keyword.value for keyword in node.keywords if keyword.arg in _KEYWORDS]
    has_text = False
    for index, argument in enumerate([*arguments, *keywords]):
        for text in texts(argument, scope, module, sources):
            filled = with_values(text, arguments[index + 1 :])
            if _is_sentence(filled):
                yield filled
                has_text = True
        if has_text and isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            return  # what follows are its values


def _level(call: ast.expr) -> str:
    if not isinstance(call, ast.Call):
        return "WARNING"
    if isinstance(call.func, ast.Attribute) and _owner(call.func) in _DEFECT_LOGS:
        return "ERROR"
    name = call.func.attr if isinstance(call.func, ast.Attribute) else ast.unparse(call.func)
    levels = [ast.unparse(keyword.value) for keyword in call.keywords if keyword.arg == "level"]
    return "ERROR" if name in _ERROR_SOURCES or any("ERROR" in level for level in levels) else "WARNING"


def _owner(method: ast.Attribute) -> str:
    """Return the name of the object that has a method."""
    match method.value:
        case ast.Name(owner) | ast.Attribute(attr=owner):
            return owner
    return ""


def _arguments(call: ast.Call) -> Sequence[ast.expr]:
    """Return the arguments that may be texts, and the values for their placeholders."""
    arguments: list[ast.expr] = []
    for argument in call.args:
        match argument:
            case ast.Starred(ast.Tuple(values)):
                arguments += values
            case _:
                arguments.append(argument)
    match call.func:
        case ast.Attribute(attr=name) if name in _LOSS_METHODS:
            return arguments[1:]
        case ast.Name("PortOpener"):
            return arguments[2:]
        case ast.Attribute(value=ast.Attribute(attr=owner)) if owner in _EVENT_LOGS:
            return arguments[1:2]
        case ast.Attribute() as method if _owner(method) in _DEFECT_LOGS:
            return arguments[1:]
    return arguments


def _logging_calls(scope: ast.AST, sources: Sources) -> Iterator[ast.Call]:
    return (node for node in sources.nodes(scope) if isinstance(node, ast.Call) and _is_loud(node))


def _is_loud(call: ast.Call) -> bool:
    """Whether a call logs at WARNING or above, or makes what is logged so."""
    match call.func:
        case ast.Attribute(attr=name) as method if (owner := _owner(method)) in _LOGGERS | _DEFECT_LOGS:
            is_log = name == "log" and owner in _LOGGERS
            says_level = is_log and re.search("level|WARNING", ast.unparse(call.args[0]))
            has_text = owner in _DEFECT_LOGS and name == "log" and len(call.args) > 1
            return name in _LOUD_METHODS or bool(says_level) or has_text
        case ast.Attribute(attr=name):
            return name in _WARNING_METHODS
        case ast.Name(name):
            return name in _LOGGED_CLASSES
    return False


def _problems(scope: ast.AST, sources: Sources) -> Iterator[ast.expr]:
    """Yield what the health names: what attributes ``problem`` are set to, and what such functions return."""
    for node in sources.nodes(scope):
        match node:
            case ast.Assign(targets=[ast.Attribute(attr=name)], value=value) if name.strip("_") in _PROBLEMS:
                yield value
    if isinstance(scope, ast.FunctionDef) and scope.name.strip("_") in _PROBLEMS:
        yield from (
            node.value for node in sources.nodes(scope) if isinstance(node, ast.Return) and node.value
        )
