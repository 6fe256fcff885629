"""The option --vectors of each example: the test vectors, random and damaged messages, other lines."""

import json
import random
import subprocess
from typing import Any

import pytest

from gateway.messages.decode import MESSAGE_TYPES_BY_NAME
from gateway.messages.encode import COUNT_OFFSET
from tests.support.example_programs import COMPONENT_TYPES, EXAMPLES, PROGRAMS, ExampleProgram, printed_errors
from tests.support.message_vectors import VECTORS, difference, random_message, to_vector_values

each_program = pytest.mark.parametrize("program", PROGRAMS, ids=str)


def line(type_name: str, data: bytes) -> bytes:
    return f"{type_name} {data.hex()}".encode()


def printed_for(program: ExampleProgram, lines: list[bytes]) -> list[Any]:
    """Return what the program prints for each line."""
    program.build()
    run = subprocess.run(
        [*program.command, "--vectors"], input=b"".join(line + b"\n" for line in lines), cwd=EXAMPLES,
        capture_output=True, check=False, timeout=120,
    )  # fmt: skip
    assert (run.returncode, printed_errors(run)) == (0, b"")
    printed = [json.loads(line, parse_constant=no_json) for line in run.stdout.decode().split("\n")[:-1]]
    assert len(printed) == len(lines)
    return printed


def no_json(text: str) -> Any:
    """Refuse NaN and Infinity, which Python's decoder takes for JSON."""
    raise ValueError(text)


@each_program
def test_each_program_decodes_the_test_vectors_and_random_messages(program: ExampleProgram) -> None:
    generator = random.Random(18)
    messages = [
        (each.lcm_type, each.data, each.values) for each in VECTORS if each.type_name in program.types
    ]
    for name in sorted(program.types):
        for _ in range(60):
            message = random_message(MESSAGE_TYPES_BY_NAME[name], generator)
            messages.append((type(message), message.encode(), to_vector_values(message)))
    found = printed_for(program, [line(lcm_type.__name__, data) for lcm_type, data, _ in messages])
    problems = [
        (lcm_type.__name__, data.hex(), problem)
        for (lcm_type, data, expected), values in zip(messages, found, strict=True)
        if (problem := difference(lcm_type, expected, values))
    ]
    assert not problems


def damaged_messages(types: frozenset[str]) -> list[bytes]:
    """Return messages that nobody can decode: too short, too long, of other types, with wrong numbers."""
    damaged: list[tuple[str, bytes]] = []
    for vector in VECTORS:
        if vector.type_name not in types:
            continue
        name, data = vector.type_name, vector.data
        damaged += [(name, data[:length]) for length in {0, 1, 7, 8, len(data) // 2, len(data) - 1}]
        damaged += [(name, bytes(8) + data[8:]), (name, b"\xff" * len(data)), (name, data + b"\0")]
        damaged += [(other, data) for other in types if other != name]
        if name in COMPONENT_TYPES:
            before, after = data[:COUNT_OFFSET], data[COUNT_OFFSET + 4 :]
            num_items = int.from_bytes(data[COUNT_OFFSET : COUNT_OFFSET + 4], "big")
            for count in (num_items + 1, 1 << 28, (1 << 31) - 1, 1 << 31, (1 << 32) - 1):
                damaged.append((name, before + count.to_bytes(4, "big") + after))
    unknown = ["nonsense_t", *sorted(set(MESSAGE_TYPES_BY_NAME) - types)]
    damaged += [(name, VECTORS[0].data) for name in unknown]
    return [line(*each) for each in damaged]


def damaged_lines(digits: bytes) -> list[bytes]:
    """Return lines that are no type and hexadecimal digits."""
    texts = [
        b"",
        digits + b"0",
        digits + b"zz",
        b"zz" + digits,
        b"0x" + digits,
        b"+1",
        b"-1",
        digits + b"\xff",
    ]
    others = [b"", b" ", b"\xff 00", b'"\\ 00', b"markers_t"]
    return [*others, *(b"markers_t " + text for text in texts)]


@each_program
def test_each_program_reports_what_it_cannot_decode(program: ExampleProgram) -> None:
    vector = next(vector for vector in VECTORS if vector.type_name == "markers_t")
    digits = vector.data.hex().encode()
    lines = [*damaged_messages(program.types), *damaged_lines(digits)]
    *found, last = printed_for(program, [*lines, b"markers_t " + digits.upper() + b"\r"])
    wrong = [
        (each, answer)
        for each, answer in zip(lines, found, strict=True)
        if list(answer) != ["error"] or not isinstance(answer["error"], str)
    ]
    assert not wrong
    assert difference(vector.lcm_type, vector.values, last) is None


@each_program
def test_each_program_survives_messages_with_random_bytes(program: ExampleProgram) -> None:
    generator = random.Random(17)
    lines = []
    for vector in VECTORS:
        for _ in range(40 if vector.type_name in program.types else 0):
            data = bytearray(vector.data)
            for _ in range(generator.randint(1, 3)):
                value = generator.choice((0, 0x7F, 0xFF, generator.randrange(256)))
                data[generator.randrange(8, len(data))] = value
            lines.append(line(vector.type_name, bytes(data)))
    assert all(isinstance(values, dict) for values in printed_for(program, lines))


@pytest.mark.parametrize("program", [each for each in PROGRAMS if "status_t" in each.types], ids=str)
def test_each_program_reports_texts_that_are_not_utf8_up_to_a_nul(program: ExampleProgram) -> None:
    vector = next(vector for vector in VECTORS if vector.type_name == "parameters_t" and vector.values["xml"])
    texts = (b"ab", b"a\xff\0", b"\xed\xa0\x80\0", b"\xf4\x90\x80\x80\0", b"\xc0\x80\0", b"\xe2\x82\0", b"")
    begin = vector.data[:40]  # up to the only text
    damaged = [begin + len(text).to_bytes(4, "big") + text for text in texts]
    found = printed_for(
        program, [line("parameters_t", each) for data in damaged for each in (data, vector.data)]
    )
    assert [list(answer) for answer in found[::2]] == [["error"]] * len(texts)
    assert not any(difference(vector.lcm_type, vector.values, values) for values in found[1::2])
