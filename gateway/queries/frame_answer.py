"""The answer to the question in which coordinate frame the poses of a source are."""

from collections.abc import Mapping
from typing import Final

from gateway.errors import QueryError
from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.outputs.contract import Answer
from gateway.outputs.encodings import JSON, json_bytes

FRAME_KEY: Final = "frame"


def frame_answer(
    frame: CoordinateFrame,
    names: Mapping[str, Mapping[str, Mapping[str, str]]],
    options: Mapping[str, str],
) -> Answer:
    """Return the frame, and the names that outputs have given to items, as JSON.

    ``names`` are by output, component key and label. Raises QueryError if there are options.
    """
    if options:
        raise QueryError(f"{FRAME_KEY} takes no options")
    given = {output: of_output for output, of_output in names.items() if of_output}
    return Answer(json_bytes({**frame.facts, "names": given}), JSON)
