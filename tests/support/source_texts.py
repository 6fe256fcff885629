"""The texts that an expression in source code can have, with placeholders named after what they stand for."""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Final

_TRANSPARENT_CALLS: Final = {
    *("str", "repr", "safe_text", "sorted", "join", "len", "round", "format", "max", "min", "map", "_hz"),
    *("cut", "tuple", "list"),
}
"""Calls that say their first argument; its name is the better placeholder."""

_UNITS: Final = re.compile("_(s|ms|us|bytes|mib|text)$")
"""Units at the end of names, which the text beside a placeholder says as well."""

_WORDS: Final = {
    **dict.fromkeys(
        ("error", "strerror", "exc", "system_reason", "zenoh_reason", "refusal", "text"), "reason"
    ),
    **dict.fromkeys(("defect_text", "damage"), "defect"),
    **dict.fromkeys(("file_bytes", "data", "message", "held_mib", "mib", "unread_bytes_each"), "size"),
    **dict.fromkeys(("unstored", "total", "failed", "queued_bytes", "lost"), "count"),
    **dict.fromkeys(("most", "wall_s", "kept_events", "clients"), "limit"),
    **dict.fromkeys(("first", "others", "keys"), "components"),
    **dict.fromkeys(("item_noun", "noun"), "items"),
    "abs": "seconds",
    "connect": "endpoint",
    "connection": "address",
    "held_up_s": "seconds",
    "host_in_url": "host",
    "json_name": "json",
    "last": "component",
    "names": "take",
    "not_opened": "name",
    "quoted": "name",
    "ros_source": "source",
    "slow": "client",
    "unfinished": "tasks",
    "unsent": "command",
    "value": "state",
    "what": "data",
}
"""Words for users, for names in the source code that say too little without it."""


_MOST_VARIANTS: Final = 6
_MOST_NESTED: Final = 3
"""Limits of what replaces a placeholder: texts in one f-string, and f-strings within each other."""


class Sources:
    """Modules in which texts are looked up thousands of times: each syntax tree is walked only once."""

    def __init__(self, modules: Sequence[ast.Module]) -> None:
        self.constants: defaultdict[str, list[ast.expr]] = defaultdict(list)
        """The values of constants, such as ``CLOSED: Final = "…"``, in all modules, by name."""
        self.functions: defaultdict[str, list[ast.FunctionDef]] = defaultdict(list)
        """The functions outside classes, in all modules, by name."""
        self._nodes: dict[ast.AST, list[ast.AST]] = {}
        self._scopes: dict[ast.Module, list[ast.AST]] = {}
        for module in modules:
            for statement in module.body:
                match statement:
                    case ast.AnnAssign(target=ast.Name(name), value=ast.expr() as value):
                        self.constants[name].append(value)
                    case ast.FunctionDef(name):
                        self.functions[name].append(statement)

    def nodes(self, scope: ast.AST) -> list[ast.AST]:
        """Return what ``ast.walk`` yields."""
        if scope not in self._nodes:
            self._nodes[scope] = list(ast.walk(scope))
        return self._nodes[scope]

    def scopes(self, module: ast.Module) -> list[ast.AST]:
        """Return the functions, and the assignments outside functions."""
        if module not in self._scopes:
            functions = (ast.FunctionDef, ast.AsyncFunctionDef)
            self._scopes[module] = [
                *(node for node in self.nodes(module) if isinstance(node, functions)),
                *(node for node in module.body if isinstance(node, ast.Assign | ast.AnnAssign)),
            ]
        return self._scopes[module]


def with_values(text: str, values: Sequence[ast.expr]) -> str:
    """Return a text for the % operator with placeholders for its values."""
    names = (_placeholder(value) for value in values)
    return re.sub(r"%(\.\d+)?[sdrf]", lambda _: next(names, "<…>"), text)


def texts(
    node: ast.expr,
    scope: ast.AST,
    module: ast.Module,
    sources: Sources,
    outer: frozenset[ast.expr] = frozenset(),
) -> Iterator[str]:
    """Yield each text that ``node`` can have, following names and calls to literals.

    ``outer`` are the f-strings that it is a value of.
    """
    pending, seen = [(node, scope)], set(outer)
    while pending:
        node, scope = pending.pop()
        if node in seen:
            continue
        seen.add(node)
        match node:
            case ast.Constant(str(text)):
                yield text
            case ast.JoinedStr():
                yield from _filled(node, scope, module, sources, outer | {node})
            case _:
                pending += _values(node, scope, module, sources)


def _values(
    node: ast.expr, scope: ast.AST, module: ast.Module, sources: Sources
) -> Iterator[tuple[ast.expr, ast.AST]]:
    """Yield the expressions that ``node`` can have the value of, each with the function that it is in."""
    match node:
        case ast.BoolOp(values=choices):
            yield from ((choice, scope) for choice in choices)
        case ast.IfExp(body=body, orelse=orelse):
            yield from ((body, scope), (orelse, scope))
        case ast.Name(name):
            yield from ((value, scope) for value in _assigned(name, scope, sources, ast.Name))
            yield from ((value, scope) for value in _constants(name, module, sources))
            yield from _passed(name, scope, module, sources)
        case ast.Attribute(attr=name):
            for where in sources.scopes(module):
                yield from ((value, where) for value in _assigned(name, where, sources, ast.Attribute))
        case ast.Call(func=ast.Name("safe_text"), args=[text, *_]):
            yield text, scope
        case ast.Call(func=ast.Name(name)):
            yield from _returned(name, sources)


def _filled(
    text: ast.JoinedStr,
    scope: ast.AST,
    module: ast.Module,
    sources: Sources,
    outer: frozenset[ast.expr],
) -> list[str]:
    """Return an f-string with placeholders; one for each combination of texts that its values can be."""
    variants = [""]
    for part in text.values:
        match part:
            case ast.Constant(value):
                choices = [str(value)]
            case ast.FormattedValue(value=value, conversion=conversion):
                choices = []
                if len(outer) <= _MOST_NESTED and conversion != ord("r"):
                    choices = list(dict.fromkeys(texts(value, scope, module, sources, outer)))
                choices = _choices(choices, value)
                if not choices or len(variants) * len(choices) > _MOST_VARIANTS:
                    choices = [f"'{_placeholder(value)}'" if conversion == ord("r") else _placeholder(value)]
                variants = [f"{each} " if each[-1:].isalpha() else each for each in variants]
            case _:
                choices = ["…"]
        variants = [before + choice for before in variants for choice in choices]
    return variants


def _choices(candidates: Sequence[str], value: ast.expr) -> list[str]:
    """Return what stands for a value that can be these texts; nothing if its name is better."""
    found = [text for text in candidates if text]
    if any(text != text.strip() for text in found):
        return []
    if any(" " in text for text in found) or ast.unparse(value).isupper():
        return found
    are_words = len(found) == 2 and all(text.isalpha() for text in found)
    return [" or ".join(sorted(found))] if are_words else []  # "answer or acknowledge"


def _passed(
    name: str, scope: ast.AST, module: ast.Module, sources: Sources
) -> Iterator[tuple[ast.expr, ast.AST]]:
    """Yield what calls in the module pass for a parameter of the function ``scope``."""
    if not isinstance(scope, ast.FunctionDef | ast.AsyncFunctionDef):
        return
    parameters = [parameter.arg for parameter in scope.args.args if parameter.arg != "self"]
    if name not in parameters:
        return
    index = parameters.index(name)
    for caller in sources.scopes(module):
        for node in sources.nodes(caller):
            match node:
                case ast.Call(func=ast.Name(function) | ast.Attribute(attr=function), args=arguments) if (
                    function == scope.name and len(arguments) > index
                ):
                    yield arguments[index], caller


def _placeholder(node: ast.expr) -> str:
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id[0].isupper():
        return node.func.id  # a command of the protocol
    return f"<{_name(node)}>"


def _words(name: str) -> str:
    match name:
        case _ if name in _WORDS:
            return _WORDS[name]
        case _ if name.startswith("num_") or name == "count":
            return "count"
        case _ if name.startswith("max_"):
            return "limit"
        case _ if name.endswith("_hz"):
            return "rate"
    return _UNITS.sub("", name).replace("_", " ")


def _name(node: ast.expr) -> str:
    """Return words for an expression: the name of its variable, attribute or function."""
    match node:
        case ast.Constant(value):
            return str(value)
        case ast.Attribute(attr="__name__"):
            return "class"
        case ast.Attribute(value=ast.Name() | ast.Attribute() as owner, attr="name"):
            return _name(owner)
        case ast.Name(name) | ast.Attribute(attr=name):
            return _words(name.lower().strip("_"))
    part = _telling_part(node)
    return "…" if part is None else _name(part)


def _telling_part(node: ast.expr) -> ast.expr | None:
    """Return the part of an expression whose name says what the whole is."""
    match node:
        case ast.Call(func=ast.Name(name) | ast.Attribute(attr=name), args=[*_, last] as arguments) if (
            name in _TRANSPARENT_CALLS
        ):
            return last if name == "map" else arguments[0]
        case ast.BinOp(left=ast.Constant(), right=value) | ast.BoolOp(values=[value, *_]):
            return value
        case ast.GeneratorExp(elt=ast.JoinedStr([ast.FormattedValue(value), *_])):
            return value
    parts = (getattr(node, field, None) for field in ("value", "operand", "elt", "left", "body", "func"))
    return next((part for part in parts if isinstance(part, ast.expr)), None)


def _assigned(
    name: str, scope: ast.AST, sources: Sources, kind: type[ast.Name] | type[ast.Attribute]
) -> Iterator[ast.expr]:
    """Yield the values that are assigned to a variable or an attribute."""
    for node in sources.nodes(scope):
        match node:
            case ast.Assign(targets=targets, value=value):
                for target in targets:
                    match target:
                        case ast.Name(found) | ast.Attribute(attr=found) if found == name:
                            if isinstance(target, kind):
                                yield value


def _constants(name: str, module: ast.Module, sources: Sources) -> Iterator[ast.expr]:
    """Yield the value of a constant of the module or else of any other."""
    own = [
        statement.value
        for statement in module.body
        if isinstance(statement, ast.AnnAssign) and statement.value is not None
        if isinstance(statement.target, ast.Name) and statement.target.id == name
    ]
    if own or name.startswith("_"):
        yield from own
    else:
        yield from sources.constants[name]


def _returned(name: str, sources: Sources) -> Iterator[tuple[ast.expr, ast.AST]]:
    """Yield the values that a function returns, in any module."""
    for function in sources.functions[name]:
        for node in sources.nodes(function):
            if isinstance(node, ast.Return) and node.value is not None:
                yield node.value, function
