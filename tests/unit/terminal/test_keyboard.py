import pytest

from gateway.terminal.keyboard import key_names


@pytest.mark.parametrize(
    ("data", "names"),
    [
        (b"q", ["q"]),
        (b"Q1/", ["Q", "1", "/"]),
        (b" \r\n\t\x7f", ["space", "enter", "enter", "tab", "backspace"]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"\x1bOA\x1bOB", ["up", "down"]),
        (b"\x1b[5~\x1b[6~\x1b[H\x1b[F\x1b[Z", ["page-up", "page-down", "home", "end", "shift-tab"]),
        (b"\x1b", ["escape"]),
        ("é€😀".encode(), ["é", "€", "😀"]),
    ],
)
def test_names_of_keys(data: bytes, names: list[str]) -> None:
    assert key_names(data) == names


@pytest.mark.parametrize(
    "data", [b"\x1b[200~", b"\x1b[1;5Q", b"\x01\x02\0", b"\xff\x80", b"\xc3", b"\x1b[<0;3;4M"]
)
def test_keys_without_a_name_are_left_out(data: bytes) -> None:
    assert key_names(data) == []
