"""Finds the messages that the gateway can log at WARNING and above, in its source code."""

import ast
import re
from collections.abc import Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Final

_EVENT_LOGS: Final = {"events", "_events"}
"""Their second argument is the text."""

_LOGGERS: Final = {"logger", "_log", "_logger", *_EVENT_LOGS}
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

_KEYWORDS: Final = {"limitation", "not_open", "cannot_open", "no_router"}
"""The keywords of calls whose values are logged."""

_PRINTING_PACKAGES: Final = {"cli", "client", "doctor"}
"""Commands that print their errors instead of logging them, and what raises them."""

_PRINTING_MODULES: Final = {"checks.py", "subscriber.py"}
"""The modules of outputs that only commands use."""


def message_patterns(package: Path) -> dict[str, str]:
    """Return a regular expression for each message, with ``.+`` for its values, and where it is logged."""
    found: dict[str, str] = {}
    modules = {path: ast.parse(path.read_text()) for path in sorted(package.rglob("*.py"))}
    for path, module in modules.items():
        if path.relative_to(package).parts[0].removesuffix(".py") in _PRINTING_PACKAGES:
            continue
        if path.name in _PRINTING_MODULES:
            continue
        for scope in _scopes(module):
            for call in _logging_calls(scope):
                arguments = [
                    *_arguments(call),
                    *(keyword.value for keyword in call.keywords if keyword.arg in _KEYWORDS),
                ]
                texts = chain.from_iterable(
                    _texts(node, scope, module, list(modules.values())) for node in arguments
                )
                for text in filter(re.compile("[a-z]{3}").search, texts):
                    found.setdefault(text, f"{path.relative_to(package)}:{call.lineno}")
    return found


def _arguments(call: ast.Call) -> Sequence[ast.expr]:
    """Return the arguments that may be texts."""
    match call.func:
        case ast.Attribute(attr=name) if name in _LOSS_METHODS:
            return call.args[1:]
        case ast.Attribute(value=ast.Attribute(attr=owner)) if owner in _EVENT_LOGS:
            return call.args[1:2]
    return call.args


def _scopes(module: ast.Module) -> Iterator[ast.AST]:
    """Yield the functions, and the assignments outside functions."""
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
    for node in module.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield node


def _logging_calls(scope: ast.AST) -> Iterator[ast.Call]:
    for node in ast.walk(scope):
        match node:
            case ast.Call(
                func=ast.Attribute(value=ast.Name(owner) | ast.Attribute(attr=owner), attr=name)
            ) if owner in _LOGGERS:
                is_loud = name == "log" and re.search("level|WARNING", ast.unparse(node.args[0]))
                if name in _LOUD_METHODS or is_loud:
                    yield node
            case ast.Call(func=ast.Attribute(attr=name)) if name in _WARNING_METHODS:
                yield node
            case ast.Call(func=ast.Name(name)) if name in _LOGGED_CLASSES:
                yield node


def _texts(
    node: ast.expr, scope: ast.AST, module: ast.Module, modules: Sequence[ast.Module]
) -> Iterator[str]:
    """Yield a pattern for each text that ``node`` can have, following names and calls to literals."""
    pending, seen = [(node, scope)], set()
    while pending:
        node, scope = pending.pop()
        if node in seen:
            continue
        seen.add(node)
        match node:
            case ast.Constant(str(text)):
                yield re.sub(r"%(\\\.\d+)?[sdrf]", ".+", re.escape(text))
            case ast.JoinedStr(parts):
                yield "".join(
                    re.escape(str(part.value)) if isinstance(part, ast.Constant) else ".+" for part in parts
                )
            case ast.BoolOp(values=choices):
                pending += [(choice, scope) for choice in choices]
            case ast.Name(name):
                pending += [(value, scope) for value in _assigned(name, scope)]
                pending += [(value, scope) for value in _constants(name, modules)]
            case ast.Attribute(attr=name):
                pending += [(value, scope) for value in _assigned(name, module)]
            case ast.Call(func=ast.Name(name)):
                pending += _returned(name, modules)


def _assigned(name: str, scope: ast.AST) -> Iterator[ast.expr]:
    """Yield the values that are assigned to a variable or an attribute."""
    for node in ast.walk(scope):
        match node:
            case ast.Assign(targets=[ast.Name(target) | ast.Attribute(attr=target)], value=value):
                if target == name:
                    yield value


def _constants(name: str, modules: Sequence[ast.Module]) -> Iterator[ast.expr]:
    """Yield the value of a module's constant, such as ``CLOSED: Final = "…"``."""
    for statement in chain.from_iterable(module.body for module in modules):
        match statement:
            case ast.AnnAssign(target=ast.Name(target), value=ast.expr() as value) if target == name:
                yield value


def _returned(name: str, modules: Sequence[ast.Module]) -> Iterator[tuple[ast.expr, ast.AST]]:
    """Yield the values that a function returns, in any module."""
    for function in chain.from_iterable(module.body for module in modules):
        if isinstance(function, ast.FunctionDef) and function.name == name:
            for node in ast.walk(function):
                if isinstance(node, ast.Return) and node.value is not None:
                    yield node.value, function
