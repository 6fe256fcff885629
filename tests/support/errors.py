"""What tests check of an error: its class, its fields, and the values in its text; not the sentence."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

import pytest

Error = TypeVar("Error", bound=BaseException)


@contextmanager
def raises(kind: type[Error], *values: object, **fields: object) -> Iterator[pytest.ExceptionInfo[Error]]:
    """Check that an exception of this class comes with these fields, and that its text names these values."""
    with pytest.raises(kind) as caught:
        yield caught
    assert {name: getattr(caught.value, name) for name in fields} == fields
    assert names(str(caught.value), *values), f"{caught.value} does not name {values}"


def names(text: str, *values: object) -> bool:
    """Whether a text has these values, each as words of its own, whatever the words around them are."""
    return all(re.search(rf"(?<!\w){re.escape(str(value))}(?!\w)", text) for value in values)
