"""Coverage-guided fuzzing of all code that reads bytes from outside: it may raise only documented errors.

    make fuzz FUZZ_SECONDS=600                                          all targets, this long each
    python tests/fuzz/fuzz.py TARGET CORPUS_FOLDER [libFuzzer options]  one of them

The initial corpus is the tests' hand-written vectors. An input that fails is written to the current
folder as crash-…; pass that file instead of the corpus folder to run it again.
"""

import contextlib
import logging
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["gateway"]):
    from gateway.errors import (
        CommandError,
        ConfigError,
        FrameError,
        ParametersError,
        ProtocolError,
        TakeError,
    )
    from gateway.messages.decode import decode, to_json
    from gateway.messages.encode import Stamp, encode_message
    from gateway.messages.summary import summarise
    from gateway.rtc3d.client_protocol import ClientProtocol, ProtocolState
    from gateway.rtc3d.commands import SendParameters, StreamFrames, Version, parse_command
    from gateway.rtc3d.frames import detect_byte_order, split_frame
    from gateway.rtc3d.packets import PacketReader
    from gateway.rtc3d.parameters_xml import encode_parameters, parse_parameters
    from gateway.takes import open_take
    from gateway.takes.files.statistics import take_statistics
    from gateway.tools.cli.take_report import statistics_json
    from tests.support.configurations import load
    from tests.support.takes import encode_event

from tests.support.vectors import COMPONENTS, FRAME_WITH_UNKNOWN, FULL_FRAME, PACKETS

ROOT = Path(__file__).parents[2]
STAMP = Stamp(1, 2, 3, 4)


def packets(data: bytes) -> None:
    """Any bytes in any split are packets or set an error; no more bytes are buffered than were fed."""
    provider = atheris.FuzzedDataProvider(data)
    reader = PacketReader(max_packet_bytes=4096, max_c3d_bytes=8192)
    fed = 0
    while provider.remaining_bytes():
        piece = provider.ConsumeBytes(provider.ConsumeIntInRange(0, 200))
        reader.feed(piece)
        fed += len(piece)
        assert reader.buffered_bytes <= min(fed, 8192)


def frames(data: bytes) -> None:
    """A data frame is split and its messages can be decoded, or it is rejected."""
    try:
        frame = split_frame(data, detect_byte_order(data, "big"))
    except FrameError:
        return
    for component in frame.components:
        message = encode_message(component, STAMP, 7)
        decoded = decode(message)
        summarise(decoded)
        to_json(decoded)
        assert len(component.items()) == component.num_items


def connection(data: bytes) -> None:
    """The client's protocol does not raise for any bytes from a server between its own commands."""
    provider = atheris.FuzzedDataProvider(data)
    client = ClientProtocol(max_packet_bytes=4096)
    commands = (Version(), SendParameters(), StreamFrames())
    while provider.remaining_bytes():
        if client.pending_command is None and client.state is not ProtocolState.CLOSED:
            client.send(commands[provider.ConsumeIntInRange(0, 2)])
        elif provider.ConsumeBool():
            client.give_up()
        client.receive(provider.ConsumeBytes(provider.ConsumeIntInRange(0, 300)))


def commands(data: bytes) -> None:
    """A client's command is parsed and can be encoded again, or is refused."""
    try:
        command = parse_command(data)
    except CommandError as error:
        str(error).encode("ascii")
        return
    assert parse_command(str(command).encode()) == command


def parameters(data: bytes) -> None:
    """XML is parsed, and the parameters can be encoded and parsed again, or it is refused."""
    try:
        parsed = parse_parameters(data)
    except ParametersError:
        return
    parse_parameters(encode_parameters(parsed.parameters))


def configuration(data: bytes) -> None:
    """A file is a valid configuration, or each of its mistakes is reported with its line."""
    with tempfile.NamedTemporaryFile(suffix=".yaml") as file:
        file.write(data)
        file.flush()
        try:
            load(Path(file.name))
        except ConfigError as error:
            lines = str(error).splitlines()
        else:
            return
    assert all(line.startswith(file.name) for line in lines)


def messages(data: bytes) -> None:
    """Bytes from LCM or Zenoh are one of the gateway's messages, or are refused."""
    with contextlib.suppress(ProtocolError):
        summarise(decode(data))


def take(data: bytes) -> None:
    """A file is a take whose arrays and statistics can be computed, or is refused."""
    with tempfile.NamedTemporaryFile(suffix=".lcmlog") as file:
        file.write(data)
        file.flush()
        try:
            for source in open_take(Path(file.name)).sources.values():
                for series in source.series.values():
                    assert sum(map(len, series.runs())) == len(series)
            statistics_json(take_statistics(Path(file.name)))
        except TakeError as error:
            text = str(error)
        else:
            return
    assert file.name in text or "runs()" in text


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target
    for target in (packets, frames, connection, commands, parameters, configuration, messages, take)
}


def seeds() -> Iterator[bytes]:
    """Yield the initial corpus, the same for all targets; libFuzzer keeps the useful inputs."""
    for vector in PACKETS:
        yield vector.packet
    for component in COMPONENTS:
        yield from component.wire.values()
    yield from FULL_FRAME.values()
    yield from FRAME_WITH_UNKNOWN.values()
    yield from (str(command).encode() for command in (Version(), SendParameters(("3d",)), StreamFrames()))
    log = b""
    for number, part in enumerate(split_frame(FULL_FRAME["big"], "big").components):
        channel = f"MOCAP_LAB_{part.type.key.upper()}".encode()
        log += encode_event(number, number, channel, encode_message(part, STAMP, number))
        yield log
    for folder, pattern in (("tests/data/spec_xml", "*.xml"), ("config", "*.yaml")):
        for path in (ROOT / folder).glob(pattern):
            yield path.read_bytes()


def main() -> None:
    if len(sys.argv) < 3 or sys.argv[1] not in TARGETS:
        sys.exit(f"{__doc__}\nTARGET is one of {', '.join(TARGETS)}")
    logging.disable()
    target = TARGETS[sys.argv.pop(1)]
    corpus = Path(sys.argv[1])
    if not corpus.is_file():
        corpus.mkdir(parents=True, exist_ok=True)
        for number, seed in enumerate(seeds()):
            (corpus / f"seed-{number:03}").write_bytes(seed)
    atheris.Setup(sys.argv, target)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
