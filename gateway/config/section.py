"""The base class of all parts of the configuration: immutable, with readable validation errors."""

import difflib
from collections.abc import Iterable, Mapping
from typing import Any, Final, Self

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
"""The error type of an unknown key; all other errors concern a value or its absence."""

_INVALID_VALUE: Final = "invalid_value"


class Section(BaseModel):
    """A mapping of the configuration: unknown keys are errors, and instances are immutable."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    @model_validator(mode="wrap")
    @classmethod
    def _reword_errors(cls, value: Any, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Replace pydantic's texts for a wrong type, unknown keys and missing keys."""
        known = ", ".join(cls.model_fields)
        if not isinstance(value, Mapping | cls):
            found = f"found {describe(value)}"
            raise validation_error(f"{found}; expected a mapping with any of the keys {known}")
        try:
            return validate(value)
        except ValidationError as error:
            errors = []
            for details in error.errors(include_url=False):
                location, kind, text = details["loc"], details["type"], details["msg"]
                if kind == "extra_forbidden":
                    kind = UNKNOWN_KEY
                    text = f"unknown key{spelling_hint(location[-1], cls.model_fields)}; known keys: {known}"
                elif kind == "missing":
                    text = "missing; this key is required"
                errors.append(_error_details(text, location, kind))
            raise ValidationError.from_exception_data(cls.__name__, errors) from None


def validation_error(text: str, *location: str | int) -> ValidationError:
    """Return the error for a validator to raise; ``location`` is relative to the validated value."""
    details = _error_details(text, location, _INVALID_VALUE)
    return ValidationError.from_exception_data("configuration", [details])


def expects(what: str) -> WrapValidator:
    """Return an annotation that replaces a type's error by "found …; expected ``what``"."""

    def check(value: object, validate: ValidatorFunctionWrapHandler) -> object:
        try:
            return validate(value)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            if first["loc"]:
                raise  # the error of an item inside the value, which has its own text
            unquoted = first["type"] == "string_type" and isinstance(value, bool | int | float)
            hint = " (use quotes to make it text)" if unquoted else ""
            raise validation_error(f"found {describe(value)}{hint}; expected {what}") from None

    return WrapValidator(check)


def describe(value: object) -> str:
    """Return ``value`` for use in a sentence: printable, on one line, bounded, without passwords."""
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
    """Return " (did you mean 'x'?)" if ``word`` is similar to ``x``, one of ``known``, else ""."""
    near = difflib.get_close_matches(str(word).lower()[:60], known, n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _error_details(text: str, location: tuple[str | int, ...], kind: str) -> InitErrorDetails:
    # The text is an argument of the template, not the template: it may contain braces.
    return InitErrorDetails(
        type=PydanticCustomError(kind, "{text}", {"text": text}), loc=location, input=None
    )
