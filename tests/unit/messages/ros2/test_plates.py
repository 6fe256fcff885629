"""The centres of pressure of many loads are those of each of them."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from gateway.messages.coordinate_frame import CoordinateFrame
from gateway.messages.descriptions.force_plates import PlacedPlate
from gateway.messages.ros2.plates import PlateFrame

PLATE = PlacedPlate("left", [], (0.5, 0.25, 0.0), (0.0, 0.0, 1.0), 1.0, 1e-3)
FRAMES = (
    CoordinateFrame("hall", 1e-3, (0.0, 0.0, 0.6, 0.8), (1.0, 2.0, 3.0), 2.0),
    CoordinateFrame("hall", 1e-3, translation_m=(1.0, 2.0, 3.0)),
    CoordinateFrame("hall", 1e-3, scale=2.0),
)
LOADS = st.floats(-2000, 2000, width=32) | st.sampled_from([10.0, -10.0, 0.0, np.inf, np.nan])


@given(arrays(np.float32, (5, 6), elements=LOADS), st.sampled_from(FRAMES))
def test_rows_have_the_centres_of_single_loads(loads: np.ndarray, source: CoordinateFrame) -> None:
    frame = PlateFrame(PLATE, source, "lab/force_1")
    single = [frame.centre_of_pressure(load) for load in loads.tolist()]
    has_contact, centres = frame.centres_of_pressure(loads)
    assert has_contact.tolist() == [each is not None for each in single]
    expected = np.array([each for each in single if each is not None]).reshape(-1, 3)
    assert np.allclose(centres, expected, rtol=1e-9, atol=1e-9)
