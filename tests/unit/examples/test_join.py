"""How examples/join.py pairs frames of markers with analog samples."""

import importlib.util
import struct
from pathlib import Path
from typing import Any

import pytest

from gateway.rtc3d.components import ComponentType
from tests.support.joined_components import SCENARIOS, Pair, Scenario
from tests.support.takes import frame, markers

EXAMPLE = Path(__file__).parents[3] / "examples/join.py"
_, MESSAGE = markers(2, 7)


@pytest.fixture(scope="module")
def example() -> Any:
    spec = importlib.util.spec_from_file_location("join_example", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_frames_get_the_samples_since_the_frame_before(example: Any, scenario: Scenario) -> None:
    join = example.Join()
    pairs = [
        Pair(frame.timestamp_us, tuple(sample.timestamp_us for sample in samples))
        for component, timestamp_us in scenario.messages
        for frame, samples in join.add(component, example.Timed(timestamp_us, 0, None))
    ]
    assert pairs == list(scenario.pairs)


def test_a_frame_waits_for_the_sample_of_its_time(example: Any) -> None:
    join = example.Join()
    for timestamp_us in (0, 5000):
        assert list(join.add(example.MARKERS, example.Timed(timestamp_us, 0, None))) == []
    assert list(join.add(example.ANALOG, example.Timed(4500, 0, None))) == []
    [(frame, samples)] = join.add(example.ANALOG, example.Timed(5000, 0, None))
    assert (frame.timestamp_us, [sample.timestamp_us for sample in samples]) == (5000, [4500, 5000])


def test_samples_without_frames_do_not_fill_the_memory(example: Any) -> None:
    join = example.Join()
    for timestamp_us in range(example.MAX_SAMPLES + 7):
        assert list(join.add(example.ANALOG, example.Timed(timestamp_us, 0, None))) == []
    assert join.num_dropped_samples == 7


def test_frames_without_samples_do_not_fill_the_memory(example: Any) -> None:
    join = example.Join()
    num_pairs = sum(
        len(list(join.add(example.MARKERS, example.Timed(timestamp_us, 0, None))))
        for timestamp_us in range(example.MAX_FRAMES + 10)
    )
    assert num_pairs == 9  # the first frame has no frame before it


@pytest.mark.parametrize(
    ("channels", "mean"),
    [([[1.0, 9.0], [3.0, 9.0]], "2.000"), ([[], []], "nan"), ([[1.0], [3.0, 9.0]], "2.000")],
)
def test_samples_may_have_any_number_of_channels(
    example: Any, capsys: pytest.CaptureFixture[str], channels: list[list[float]], mean: str
) -> None:
    samples = [example.decode("analog", frame(ComponentType.ANALOG, each, 7)[1]) for each in channels]
    example.print_pair(example.decode("3d", MESSAGE), samples)
    text = capsys.readouterr().out
    assert text.endswith(f"2 analog samples (frames 7 to 7), mean of channel 1: {mean}\n")


@pytest.mark.parametrize(
    "message",
    [MESSAGE[:-1], MESSAGE + b"x", MESSAGE[:52] + b"\xff" * 4 + MESSAGE[56:], bytes(8) + MESSAGE[8:], b""],
    ids=["too short", "too long", "a negative number of items", "another fingerprint", "empty"],
)
def test_malformed_messages_are_errors(example: Any, message: bytes) -> None:
    with pytest.raises((ValueError, struct.error)):
        example.decode("3d", message)
