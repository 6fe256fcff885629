"""The base class of all parts of the configuration: frozen, and with the gateway's error texts."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from gateway.config.secrets import mask_secrets_in_text

UNKNOWN_KEY: Final = "unknown_key"
"""The error type of a key that does not exist; all other errors are about a value or its absence."""

_MISTAKE: Final = "mistake"


class Effective(NamedTuple):
    """The value used for a key that is not set, and the environment variables that it may come from."""

    value: Any
    variables: tuple[str, ...] = ()


class Section(BaseModel):
    """A mapping in the configuration: frozen, and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

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


def validation_error(text: str, *location: str | int) -> ValidationError:
    """Return the error for a validator to raise; ``location`` is relative to the value that it validates."""
    return ValidationError.from_exception_data("configuration", [_line_error(text, location, _MISTAKE)])


def expects(what: str) -> WrapValidator:
    """Return an annotation that rewords errors of the type beside it: "found VALUE; expected ``what``"."""

    def check(value: object, validate: ValidatorFunctionWrapHandler) -> object:
        try:
            return validate(value)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            if first["loc"]:
                raise  # the error is in an item of the value, and already has its own text
            unquoted = first["type"] == "string_type" and isinstance(value, bool | int | float)
            hint = " (use quotes to make it text)" if unquoted else ""
            raise validation_error(f"found {describe(value)}{hint}; expected {what}") from None

    return WrapValidator(check)


def describe(value: object) -> str:
    """Return a value as part of a sentence: printable, on one line, of limited length, without passwords."""
    match value:
        case None:
            return "nothing"
        case bool():
            return "true" if value else "false"
        case Mapping():
            return "a mapping" if value else "an empty mapping"
        case list() | tuple():
            return "a list" if value else "an empty list"
        case str():
            text = mask_secrets_in_text(value)
            return repr(text if len(text) <= 60 else text[:60] + "…")
    return str(value)


def join_or(words: Iterable[str]) -> str:
    """Return "a, b or c"."""
    *others, last = words
    return f"{', '.join(others)} or {last}" if others else last


def spelling_hint(word: object, known: Iterable[str]) -> str:
    """Return " (did you mean 'x'?)" if ``word`` is similar to ``x``, a member of ``known``; else ""."""
    near = difflib.get_close_matches(str(word).lower()[:60], known, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _line_error(text: str, location: tuple[str | int, ...], kind: str) -> InitErrorDetails:
    # The text is an argument of the template, because pydantic replaces braces in the template itself.
    return InitErrorDetails(
        type=PydanticCustomError(kind, "{text}", {"text": text}), loc=location, input=None
    )
