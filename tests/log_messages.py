"""What the gateway can say in its log at WARNING and above, read from its source text."""

import ast
import re
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Final

_LOGGERS: Final = {"logger", "_log"}
_LOUD: Final = {"warning", "error", "exception", "critical"}
"""Their methods at WARNING and above; ``log`` may be, too."""

_TELLING: Final = {"failed", "limit", "_limit"}
"""Methods that log what they are given as WARNING, the first time at least."""

_TOLD: Final = {
    *("LinkError", "ConnectError", "ReplyTimeoutError", "SilenceError", "ClosedError"),
    *("PacketError", "OutputError", "OutputHealth", "SpoolError"),
}
"""Objects whose texts become such messages."""

_PRINTED: Final = {"cli", "cli_configuration", "demo", "echo", "listening", "params", "doctor"}
"""Commands that end with their errors, printed and not logged."""


def told_patterns(package: Path) -> dict[str, str]:
    """Return a regular expression for each message, and where it is; values in it are ``.+``."""
    found: dict[str, str] = {}
    for path in sorted(package.rglob("*.py")):
        if path.relative_to(package).parts[0].removesuffix(".py") in _PRINTED:
            continue
        module = ast.parse(path.read_text())
        for scope in _scopes(module):
            for call in _calls(scope):
                texts = chain.from_iterable(_texts(node, scope, module) for node in call.args)
                for text in filter(re.compile("[a-z]{3}").search, texts):
                    found.setdefault(text, f"{path.relative_to(package)}:{call.lineno}")
    return found


def _scopes(module: ast.Module) -> Iterator[ast.AST]:
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
    for node in module.body:
        if isinstance(node, ast.Assign | ast.AnnAssign):
            yield node


def _calls(scope: ast.AST) -> Iterator[ast.Call]:
    for node in ast.walk(scope):
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Name(owner), attr=name)) if owner in _LOGGERS:
                if name in _LOUD or (name == "log" and re.search("level|WARNING", ast.unparse(node.args[0]))):
                    yield node
            case ast.Call(func=ast.Attribute(attr=name)) if name in _TELLING:
                yield node
            case ast.Call(func=ast.Name(name)) if name in _TOLD:
                yield node


def _texts(node: ast.expr, scope: ast.AST, module: ast.Module) -> Iterator[str]:
    """Yield patterns of what a text can be: literals, and what names and functions stand for."""
    todo, seen = [(node, scope)], set()
    while todo:
        node, scope = todo.pop()
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
                todo += [(choice, scope) for choice in choices]
            case ast.Name(name):
                todo += [(value, scope) for value in _assigned(name, scope)]
            case ast.Attribute(attr=name):
                todo += [(value, scope) for value in _assigned(name, module)]
            case ast.Call(func=ast.Name(name)):
                todo += _returned(name, module)


def _assigned(name: str, where: ast.AST) -> Iterator[ast.expr]:
    for node in ast.walk(where):
        match node:
            case ast.Assign(targets=[ast.Name(target) | ast.Attribute(attr=target)], value=value):
                if target == name:
                    yield value


def _returned(name: str, module: ast.Module) -> Iterator[tuple[ast.expr, ast.AST]]:
    for function in module.body:
        if isinstance(function, ast.FunctionDef) and function.name == name:
            for node in ast.walk(function):
                if isinstance(node, ast.Return) and node.value is not None:
                    yield node.value, function
