"""Whatever is published between the start and the stop of a take is in its file, byte for byte, in order."""

import asyncio
import tempfile
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.outputs.contract import ServerParameters
from tests.recording_output import events, still_lab

STEPS = st.lists(
    st.one_of(
        st.tuples(st.sampled_from(["3d", "event", "6d"]), st.integers(0, 20)),
        st.tuples(st.just("parameters"), st.integers(0, 100)),
        st.tuples(st.sampled_from(["start", "stop", "pause"]), st.just(0)),
    ),
    max_size=60,
)


@settings(max_examples=50)
@given(steps=STEPS)
def test_a_take_is_what_was_published(steps: list[tuple[str, int]]) -> None:
    """However starts, stops, frames and parameters follow each other."""
    with tempfile.TemporaryDirectory() as folder:
        expected = asyncio.run(_record(Path(folder), steps))
        for name, messages in expected.items():
            found = events(Path(folder) / "lab" / f"{name}.lcmlog")[1:]
            assert [event.message for event in found if not event.channel.endswith("_PARAMETERS")] == [
                message for message in messages if isinstance(message, bytes)
            ]
            assert [event.channel.endswith("_PARAMETERS") for event in found] == [
                not isinstance(message, bytes) for message in messages
            ]


async def _record(folder: Path, steps: list[tuple[str, int]]) -> dict[str, list[bytes | None]]:
    """Make the steps; return what each take must have, None for parameters."""
    takes: dict[str, list[bytes | None]] = {}
    running: list[bytes | None] | None = None
    has_parameters = False
    async with still_lab(folder) as lab:
        for number, (step, size) in enumerate(steps):
            match step:
                case "start" if running is None:
                    await lab.takes.start("lab", str(number))
                    running = takes[str(number)] = [None] if has_parameters else []
                case "stop" if running is not None:
                    await lab.takes.stop("lab")
                    running = None
                case "pause":
                    await lab.takes.written()
                case "parameters":
                    xml = b"<!--" + b"x" * (size * 1000) + b"-->"
                    sent = lab.output.publish_parameters("lab", ServerParameters(xml, 1, number))
                    if sent is not None:
                        await sent
                    has_parameters = True
                    if running is not None:
                        running.append(None)
                case "3d" | "event" | "6d":
                    message = lab.publish(step, size if step == "3d" else 0)
                    if running is not None:
                        running.append(message)
    return takes
