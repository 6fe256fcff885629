"""The base class of all parts of the configuration: frozen, and with the gateway's error texts."""

import ast
import inspect
import re
import textwrap
from collections.abc import Mapping, Sequence
from decimal import Decimal
from itertools import pairwise
from typing import Any, Final, NamedTuple, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    TypeAdapter,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from gateway.config.words import describe, spelling_hint
from gateway.errors import ConfigError

UNKNOWN_KEY: Final = "unknown_key"
"""The error type of a key that does not exist; all other errors are about a value or its absence."""

_MISTAKE: Final = "mistake"

_EXPONENT: Final = re.compile(r"[+-]?[0-9]{1,9}(\.[0-9]{0,9})?[eE][+-]?[0-9]")


class Effective(NamedTuple):
    """The value used for a key that is not set, and the environment variables that it may come from."""

    value: Any
    variables: tuple[str, ...] = ()


class Section(BaseModel):
    """A mapping in the configuration: frozen, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @property
    def effective(self) -> dict[str, Effective]:
        """The values used for keys that are not set, by key; ``config show`` prints them."""
        return {}

    @model_validator(mode="wrap")
    @classmethod
    def _reword_errors(cls, value: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        known = ", ".join(cls.model_fields)
        if not isinstance(value, Mapping | cls):
            raise validation_error(
                f"found {describe(value)}; expected a mapping with any of the keys {known}"
            )
        try:
            return validate(value)
        except ValidationError as error:
            mistakes = []
            for details in error.errors(include_url=False):
                location, kind, text = details["loc"], details["type"], details["msg"]
                if kind == "extra_forbidden":
                    kind = UNKNOWN_KEY
                    text = f"unknown key{spelling_hint(location[-1], cls.model_fields)}; known keys: {known}"
                elif kind == "missing":
                    text = "missing; this key is required"
                mistakes.append(_line_error(text, location, kind))
            raise ValidationError.from_exception_data(cls.__name__, mistakes) from None


def key_descriptions(section: type[Section]) -> dict[str, str]:
    """Return the docstrings below the keys of a section.

    pydantic can do this, too, but would read the source text of all sections at each start, in 0.06 s.
    """
    texts: dict[str, str] = {}
    for model in reversed(section.__mro__):
        if not issubclass(model, Section):
            continue
        try:
            module = ast.parse(textwrap.dedent(inspect.getsource(model)))
        except (OSError, TypeError):  # a package without its source code
            continue
        for key, text in pairwise(getattr(module.body[0], "body", ())):
            match key, text:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(docstring))):
                    if name in section.model_fields:
                        texts[name] = inspect.cleandoc(docstring)
    return texts


def validated(kind: Any, value: object) -> Any:
    """Return a value as this type of the configuration has it. Raises ConfigError with what is expected."""
    try:
        return TypeAdapter(kind).validate_python(value)
    except ValidationError as error:
        raise ConfigError(error.errors(include_url=False)[0]["msg"]) from None


def validation_error(text: str, *location: str | int) -> ValidationError:
    """Return the error for a validator to raise; ``location`` is relative to the value that it validates."""
    return ValidationError.from_exception_data("configuration", [_line_error(text, location, _MISTAKE)])


def validation_errors(mistakes: Sequence[tuple[str, tuple[str | int, ...]]]) -> ValidationError:
    """Return the error for several mistakes: their texts, and their locations as in ``validation_error``."""
    details = [_line_error(text, location, _MISTAKE) for text, location in mistakes]
    return ValidationError.from_exception_data("configuration", details)


def expects(what: str) -> WrapValidator:
    """Return an annotation that rewords errors of the type beside it: "found VALUE; expected ``what``"."""

    def check(value: object, validate: ValidatorFunctionWrapHandler) -> object:
        try:
            return validate(value)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            if first["loc"]:
                raise  # the error is in an item of the value, and already has its own text
            hint = ""
            if first["type"] == "string_type" and isinstance(value, bool | int | float):
                hint = " (use quotes to make it text)"
            elif first["type"] == "float_type" and isinstance(value, str) and _EXPONENT.fullmatch(value):
                hint = f" (write it as {format(Decimal(value), 'f')})"  # 1e-3 is text in YAML
            raise validation_error(
                f"found {describe(value, show_items=True)}{hint}; expected {what}"
            ) from None

    return WrapValidator(check)


def _line_error(text: str, location: tuple[str | int, ...], kind: str) -> InitErrorDetails:
    # The text is an argument of the template, because pydantic replaces braces in the template itself.
    return InitErrorDetails(
        type=PydanticCustomError(kind, "{text}", {"text": text}), loc=location, input=None
    )
