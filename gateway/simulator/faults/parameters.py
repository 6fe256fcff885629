"""Parameter types that several kinds of faults use, and the text form of a parameter's value."""

from typing import Annotated, Final

from pydantic import Field

from gateway.config.section import expects

MAX_SECONDS: Final = 86400

Seconds = Annotated[
    float,
    Field(strict=True, ge=0, le=MAX_SECONDS, allow_inf_nan=False),
    expects(f"a number of seconds from 0 to {MAX_SECONDS}"),
]
Interval = Annotated[
    float,
    Field(strict=True, ge=0.01, le=MAX_SECONDS, allow_inf_nan=False),
    expects(f"a number of seconds from 0.01 to {MAX_SECONDS}"),
]
Milliseconds = Annotated[
    float,
    Field(strict=True, gt=0, le=600_000, allow_inf_nan=False),
    expects("a number of milliseconds above 0, up to 600000"),
]
Count = Annotated[int, Field(strict=True, ge=1, le=1_000_000), expects("a whole number from 1 to 1000000")]


def parameter_text(value: object) -> str:
    """Return a parameter's value in the form of the command line."""
    match value:
        case bool():
            return "true" if value else "false"
        case float():
            return f"{value:.12g}"
        case tuple() | list():
            return f"[{','.join(map(parameter_text, value))}]"
    return str(value)
