"""A seek reads from a place that an earlier pass has found. It must give the same as reading everything."""

from pathlib import Path
from tempfile import TemporaryDirectory

from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.takes.files.reader import TakeReader
from gateway.takes.replay.play_list import Entry, SeekIndex, Selection, play_list
from gateway.takes.replay.timeline import ReplayTimeline
from tests.takes import START_UTIME, description, markers, parameters, write_take

XML = b"<Parameters><The_3D><Markers>1</Markers></The_3D></Parameters>"

steps = st.tuples(
    st.sampled_from(["lab", "stage"]),
    st.sampled_from(["frame", "frame", "frame", "parameters"]),
    st.sampled_from([0, *[300_000] * 5, 2_500_000, 60_000_000, -10_000_000]),  # gaps, steps of the clock
)


def entries(reader: TakeReader, start_us: int, index: SeekIndex | None) -> list[Entry]:
    return list(play_list(reader, Selection(), ReplayTimeline(), start_us, index))


@settings(max_examples=60)
@given(
    st.lists(steps, min_size=15, max_size=60),
    st.integers(1, 3),
    st.lists(st.integers(0, 8_000_000), min_size=2, max_size=6),
)
def test_reading_from_the_index_gives_the_same(
    made: list[tuple[str, str, int]], num_files: int, starts: list[int]
) -> None:
    """Whatever the gaps, the steps of clocks and the division into files are."""
    utimes = dict.fromkeys(("lab", "stage"), START_UTIME)
    messages = [description(), description("stage")]  # one for each source
    for number, (source, kind, step_us) in enumerate(made):
        utimes[source] += step_us
        if kind == "frame":
            messages.append(markers(1, number, source=source, utime=utimes[source]))
        else:
            messages.append(parameters(XML, number, source=source, utime=utimes[source]))
    with TemporaryDirectory() as folder:
        size = -(-len(messages) // num_files)
        for place in range(0, len(messages), size):
            write_take(Path(folder) / f"{place:04}.lcmlog", messages[place : place + size])
        reader, index = TakeReader(Path(folder)), SeekIndex()
        for start_us in starts:
            assert entries(reader, start_us, index) == entries(reader, start_us, None)
