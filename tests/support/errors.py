"""What tests check of an error: its class, its fields, and the values in its text; not the sentence."""

import re
from collections.abc import Iterable, Sequence
from typing import TypeVar

import pytest

Error = TypeVar("Error", bound=BaseException)


def raises(kind: type[Error], *values: object, **fields: object) -> pytest.RaisesExc[Error]:
    """Expect an exception of this class with these fields, whose text names these values."""

    def check(error: Error) -> bool:
        assert {name: getattr(error, name) for name in fields} == fields
        assert names(str(error), *values), f"{error} does not name {values}"
        return True

    return pytest.raises(kind, check=check)


def names(text: str, *values: object) -> bool:
    """Whether a text has these values, each as words of its own, whatever the words around them are."""
    return all(re.search(rf"(?<!\w){re.escape(str(value))}(?!\w)", text) for value in values)


def one_names(texts: Iterable[str], *values: object) -> bool:
    """Whether one of the texts names these values."""
    return any(names(text, *values) for text in texts)


def each_names(texts: Sequence[str], *values_of_each: Sequence[object]) -> bool:
    """Whether there are as many texts as lists of values, and each text names its values."""
    return len(texts) == len(values_of_each) and all(
        names(text, *values) for text, values in zip(texts, values_of_each, strict=True)
    )
