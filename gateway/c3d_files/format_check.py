"""Whether what a server sends as a C3D file is one, by its first bytes."""

from typing import Final

HEAD_BYTES: Final = 2
_BLOCK_BYTES: Final = 512
_KEY: Final = 0x50
_FIRST_PARAMETER_BLOCK: Final = 2


def problem_of_c3d(head: bytes, file_bytes: int) -> str:
    """Return why a file of ``file_bytes`` is no C3D file; "" if ``head``, its first HEAD_BYTES, is one's.

    A C3D file has blocks of 512 bytes. The first one is the header: byte 0 is the number, from 1, of the
    block where the parameters begin, byte 1 is the key 0x50.
    """
    if file_bytes == 0:
        return "it is empty"
    if file_bytes < _BLOCK_BYTES:
        return f"it has {file_bytes} bytes, and the header of a C3D file has {_BLOCK_BYTES}"
    if head[1] != _KEY:
        return "its first bytes are not those of a C3D file"
    if not _FIRST_PARAMETER_BLOCK <= head[0] <= 1 + file_bytes // _BLOCK_BYTES:
        return "its parameters would begin outside of it"
    return ""
