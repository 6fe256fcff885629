"""The option --vectors of each example program, with the test vectors and with damaged messages."""

import json
import random
import subprocess
from typing import Any

import pytest

from gateway.messages.decode import MESSAGE_TYPES_BY_NAME
from gateway.messages.encode import COUNT_OFFSET
from tests.example_programs import COMPONENT_TYPES, EXAMPLES, PROGRAMS, ExampleProgram
from tests.message_vectors import VECTORS, difference

each_program = pytest.mark.parametrize("program", PROGRAMS, ids=str)


def decode_with(program: ExampleProgram, messages: list[tuple[str, bytes]]) -> list[Any]:
    """Return what the program prints for each type and message."""
    program.build()
    lines = "".join(f"{type_name} {data.hex()}\n" for type_name, data in messages)
    command = [*program.command, "--vectors"]
    run = subprocess.run(
        command, input=lines, cwd=EXAMPLES, capture_output=True,
        encoding="utf-8", errors="replace", check=False, timeout=60,
    )  # fmt: skip
    assert (run.returncode, run.stderr) == (0, "")
    printed = [json.loads(line) for line in run.stdout.splitlines()]
    assert len(printed) == len(messages)
    return printed


@each_program
def test_each_program_decodes_the_test_vectors(program: ExampleProgram) -> None:
    vectors = [vector for vector in VECTORS if vector.type_name in program.types]
    found = decode_with(program, [(vector.type_name, vector.data) for vector in vectors])
    problems = {
        str(vector): problem
        for vector, values in zip(vectors, found, strict=True)
        if (problem := difference(vector.lcm_type, vector.values, values))
    }
    assert not problems


def damaged_messages(types: frozenset[str]) -> list[tuple[str, bytes]]:
    """Return messages that nobody can decode: too short, too long, of other types, with wrong numbers."""
    damaged = []
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
    return damaged


@each_program
def test_each_program_reports_messages_that_it_cannot_decode(program: ExampleProgram) -> None:
    messages = damaged_messages(program.types)
    found = decode_with(program, messages)
    wrong = [
        (name, data.hex(), answer)
        for (name, data), answer in zip(messages, found, strict=True)
        if list(answer) != ["error"] or not isinstance(answer["error"], str)
    ]
    assert not wrong


@each_program
def test_each_program_survives_messages_with_random_bytes(program: ExampleProgram) -> None:
    generator = random.Random(17)
    messages = []
    for vector in VECTORS:
        for _ in range(40 if vector.type_name in program.types else 0):
            data = bytearray(vector.data)
            for _ in range(generator.randint(1, 3)):
                data[generator.randrange(8, len(data))] = generator.choice(
                    (0, 0x7F, 0xFF, generator.randrange(256))
                )
            messages.append((vector.type_name, bytes(data)))
    assert all(isinstance(values, dict) for values in decode_with(program, messages))


@each_program
def test_each_program_reports_types_that_it_does_not_know(program: ExampleProgram) -> None:
    unknown = ["nonsense_t", *sorted(set(MESSAGE_TYPES_BY_NAME) - program.types)]
    found = decode_with(program, [(name, VECTORS[0].data) for name in unknown])
    assert [list(answer) for answer in found] == [["error"]] * len(unknown)
