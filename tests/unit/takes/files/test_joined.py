"""Several takes opened as one: joined in time, each message once, labels of each take its own."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import Marker, Parameters, Parameters3D
from gateway.takes import Take, open_take
from gateway.takes.files.series import Series
from tests.support.takes import START_UTIME, Message, details, frame, markers, parameters, write_take
from tests.unit.takes.export.exported import labelled


def joined(folder: Path, *takes: Iterable[Message], **options: float) -> Take:
    """Return takes of these messages as one."""
    paths = [write_take(folder / f"{n}.lcmlog", messages) for n, messages in enumerate(takes)]
    return open_take(paths, **options)  # type: ignore[arg-type]


def markers_in(take: Take, name: str = "lab") -> Series:
    series = take.sources[name].markers
    assert series
    return series


def test_sources_of_one_name_follow_each_other_and_others_are_side_by_side(tmp_path: Path) -> None:
    first = [details("Ada"), *(markers(2, number) for number in range(3))]
    second = [*(markers(2, number) for number in range(500, 503)), details("Eve")]
    other = [markers(1, number, source="studio") for number in range(400, 402)]
    take = joined(tmp_path, second, other, first)  # the order does not matter
    found = markers_in(take)
    assert found.sequence.tolist() == [0, 1, 2, 500, 501, 502]
    assert found.values[:, 0, 1].tolist() == [0, 1, 2, 500, 501, 502]
    assert (take.path, take.start_utime) == (None, START_UTIME)
    assert take.sources["lab"].details.subject == "Ada"
    assert markers_in(take, "studio").seconds.tolist() == [3.998, 4.008]
    assert [run.sequence.tolist() for run in found.runs()] == [[0, 1, 2, 500, 501, 502]]


def test_takes_that_overlap_have_each_message_once_and_fill_each_others_gaps(tmp_path: Path) -> None:
    """As from two recorders of one gateway. Several events in a message are equal in time, and all stay."""

    def messages(*numbers: int) -> list[Message]:
        events = [(number, 5, -1, -1, -1) for number in (7, 8, 7)]
        both = ([markers(1 + n % 2, n), frame(ComponentType.EVENT, events, n)] for n in numbers)
        return [message for messages in both for message in messages]

    take = joined(tmp_path, messages(0, 1, 2, 5, 6), messages(1, 2, 3, 4, 5), messages(6, 7))
    found = markers_in(take)
    assert found.sequence.tolist() == [*range(8)]
    assert found.values[:, 0, 1].tolist() == [*range(8)]
    assert np.isnan(found.values[:, 1, 0]).tolist() == [True, False] * 4
    events = take.sources["lab"].events
    assert events
    assert events.sequence.tolist() == [number for number in range(8) for _ in range(3)]
    assert events.items["id"].tolist() == [7, 8, 7] * 8


def test_a_message_of_another_session_with_the_same_number_is_not_the_same(tmp_path: Path) -> None:
    take = joined(tmp_path, [markers(1, 1), markers(1, 2)], [markers(1, 2, session=2)])
    assert markers_in(take).session.tolist() == [1, 1, 2]


def test_labels_and_units_of_each_take_stay_its_own(tmp_path: Path) -> None:
    """Versions of parameters start again with each gateway, and frames may come before their parameters."""
    content = Parameters(markers=Parameters3D(100.0, "mm", (Marker("1", "b"),)))
    late = parameters(content, utime=START_UTIME + 5_100_000)
    take = joined(
        tmp_path,
        [labelled("a"), markers(1, 0)],
        [markers(1, 500), late, markers(1, 520)],
        [markers(1, 900)],
    )
    found = markers_in(take)
    assert found.labels == ("a", "b", "marker 1")
    assert [run.labels for run in found.runs()] == [("a",), ("b",), ("marker 1",)]
    assert [len(run) for run in found.runs()] == [1, 2, 1]


def test_seconds_count_from_the_earliest_take_and_limit_all(tmp_path: Path) -> None:
    takes = [[markers(1, n) for n in range(start, start + 100)] for start in (0, 100, 200)]
    found = markers_in(joined(tmp_path, *takes, from_s=0.5, to_s=1.5))
    assert found.sequence.tolist() == [*range(50, 150)]
    assert found.seconds[0] == 0.498


def test_what_could_not_be_read_is_counted_in_all_takes(tmp_path: Path) -> None:
    channel, message = markers(2, 5)
    bad: list[Message] = [markers(2, 1), (channel, message[:-4]), ("SPY", b"other program")]
    take = joined(tmp_path, bad, bad)
    assert take.sources["lab"].malformed["3d"] == 2
    assert take.unknown == {"SPY": 2}
