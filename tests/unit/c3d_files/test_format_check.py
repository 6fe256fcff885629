import pytest

from gateway.c3d_files.format_check import HEAD_BYTES, problem_of_c3d


@pytest.mark.parametrize(
    ("head", "file_bytes"),
    [(b"\x02\x50", 1024), (b"\x02\x50", 512), (b"\x0a\x50", 5000), (b"\xff\x50", 10**9)],
)
def test_a_file_with_the_key_and_its_parameters_inside_is_a_c3d_file(head: bytes, file_bytes: int) -> None:
    assert len(head) == HEAD_BYTES
    assert problem_of_c3d(head, file_bytes) == ""


@pytest.mark.parametrize(
    ("head", "file_bytes", "problem"),
    [
        (b"", 0, "empty"),
        (b"\x02\x50", 511, "511 bytes"),
        (b"\x02\x51", 1024, "first bytes"),
        (b"PK", 1024, "first bytes"),
        (b"\x00\x50", 1024, "parameters"),
        (b"\x01\x50", 1024, "parameters"),
        (b"\x04\x50", 1024, "parameters"),
    ],
)
def test_other_files_are_refused_with_a_reason(head: bytes, file_bytes: int, problem: str) -> None:
    assert problem in problem_of_c3d(head, file_bytes)
