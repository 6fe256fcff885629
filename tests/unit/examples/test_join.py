"""How examples/join.py pairs frames of markers with analog samples."""

import importlib.util
from pathlib import Path
from typing import Any

import pytest

from tests.joined_components import SCENARIOS, Pair, Scenario

EXAMPLE = Path(__file__).parents[3] / "examples/join.py"


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
