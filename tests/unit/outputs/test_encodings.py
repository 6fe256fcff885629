"""The JSON of answers."""

import pytest

from gateway.outputs.encodings import json_bytes


def test_json_is_compact_and_in_utf8() -> None:
    assert json_bytes({"name": "Käfig", "values": [1, 2.5, None]}) == (
        '{"name":"Käfig","values":[1,2.5,null]}'.encode()
    )


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_numbers_that_json_does_not_have_are_errors(value: float) -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_bytes([value])
