from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gateway.rtc3d.components import ITEM_DTYPES, ComponentType, Items, described_labels, num_described_items
from gateway.simulator.synthetic import BUTTON_EVENT, SyntheticScene
from tests.support.examples import examples

Floats = npt.NDArray[np.floating[Any]]

RATE_HZ = 50.0
MINUTE = np.arange(int(60 * RATE_HZ))
NOISE_MM = 0.1
COUNTED = (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG, ComponentType.FORCE)


@pytest.fixture(scope="module")
def scene() -> SyntheticScene:
    return SyntheticScene(
        markers=23, tools=7, analog=5, plates=2, rate_hz=RATE_HZ, analog_rate_hz=500.0
    )  # 5 bodies: two have two tools, the last one has 7 markers


def table(items: Items) -> Floats:
    """Return the items with their fields as one more axis, in the native byte order."""
    values: Floats = items.view(">f4").reshape(*items.shape, -1).astype(np.float64)
    return values


def rotation(quaternion: Floats) -> Floats:
    """Return the rotation matrices, shape (n, 3, 3), of quaternions (q0, qx, qy, qz), shape (n, 4)."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def tool_and_markers(scene: SyntheticScene, tool: int) -> tuple[Floats, Floats]:
    """Return a minute of the tool's item, (frames, 8), and of its markers' items, (frames, markers, 4)."""
    tools, markers = scene.parameters.tools, scene.parameters.markers
    assert tools is not None
    assert markers is not None
    ids = [marker.id for marker in markers.markers]
    columns = [ids.index(marker_id) for marker_id in tools.tools[tool].marker_ids]
    poses = table(scene.items(ComponentType.TOOLS, MINUTE))[:, tool]
    return poses, table(scene.items(ComponentType.MARKERS, MINUTE))[:, columns]


def local_mm_of(poses: Floats, markers: Floats) -> Floats:
    """Return the markers in the tool's own coordinates, (frames, markers, 3)."""
    from_origin = markers[..., :3] - poses[:, None, 4:7]
    local_mm: Floats = np.einsum("tji,tmj->tmi", rotation(poses[:, :4]), from_origin)
    return local_mm


@pytest.mark.parametrize("tool", range(7))
def test_a_tools_markers_are_rigid_in_its_coordinates_and_fit(scene: SyntheticScene, tool: int) -> None:
    poses, markers = tool_and_markers(scene, tool)
    all_local_mm = local_mm_of(poses, markers)
    assert np.nanstd(all_local_mm, axis=0) == pytest.approx(NOISE_MM, rel=0.15)
    in_view = poses[~np.isnan(poses[:, 0])]
    assert np.linalg.norm(in_view[:, :4], axis=1) == pytest.approx(1.0, abs=1e-6)
    assert np.ptp(in_view[:, 4:7], axis=0).min() > 10  # mm: it moves
    assert np.nanmax(np.abs(np.diff(poses[:, :4], axis=0))) < 0.1  # smoothly, at 50 Hz
    # It is out of view exactly when fewer than three of its markers are visible.
    assert np.array_equal(np.isnan(poses[:, 0]), np.sum(~np.isnan(markers[..., 0]), axis=1) < 3)
    local_mm = np.nanmean(all_local_mm, axis=0)
    for pose, measured in list(zip(poses, markers, strict=True))[::100]:
        if np.isnan(pose[0]):
            continue
        visible = ~np.isnan(measured[:, 0])
        off_mm = measured[visible, :3] - (local_mm[visible] @ rotation(pose[None, :4])[0].T + pose[4:7])
        assert pose[7] == pytest.approx(np.sqrt(np.mean(np.sum(off_mm**2, axis=1))), abs=0.02)


def test_missing_markers_and_tools_have_the_bytes_of_the_specification(scene: SyntheticScene) -> None:
    markers = scene.items(ComponentType.MARKERS, MINUTE)
    tools = scene.items(ComponentType.TOOLS, MINUTE)
    missing_markers = {item.tobytes() for item in markers[np.isnan(markers["x"])]}
    assert missing_markers == {b"\xff" * 12 + bytes.fromhex("4479C000")}  # 999.0
    assert {item.tobytes() for item in tools[np.isnan(tools["x"])]} == {b"\xff" * 32}


@given(first=st.integers(0, 10**9), cut=st.integers(0, 40))
def test_a_sample_does_not_depend_on_the_others_in_one_call(first: int, cut: int) -> None:
    scene = SyntheticScene(markers=100, tools=10, analog=3, plates=2)
    samples = np.arange(first, first + 40)
    for component in scene.rates_hz:
        whole = scene.items(component, samples)
        parts = scene.items(component, samples[:cut]), scene.items(component, samples[cut:])
        assert b"".join(part.tobytes() for part in parts) == whole.tobytes()


def test_channels_are_sines_of_different_frequencies(scene: SyntheticScene) -> None:
    voltages = table(scene.items(ComponentType.ANALOG, np.arange(10_000)))[..., 0]  # 20 s at 500 Hz
    spectrum = np.abs(np.fft.rfft(voltages, axis=0))
    assert (np.argmax(spectrum, axis=0) / 20).tolist() == [0.5, 1.25, 2.0, 2.75, 3.5]
    assert np.all(np.max(np.abs(voltages), axis=0) > 100)  # mV


def steps_on(scene: SyntheticScene, plate: int) -> list[Floats]:
    """Return the force items, (samples, 6), of each whole step on the plate in 6 s."""
    forces = table(scene.items(ComponentType.FORCE, np.arange(3000)))[:, plate]
    edges = np.flatnonzero(np.diff((forces[:, 2] > 30).astype(int)))
    return [forces[a + 1 : b] for a, b in pairwise(edges) if forces[a + 1, 2] > 30]


@pytest.mark.parametrize("plate", [0, 1])
def test_steps_have_two_peaks_and_roll_from_heel_to_toe(scene: SyntheticScene, plate: int) -> None:
    force = scene.parameters.force
    assert force is not None
    described = force.plates[plate]
    assert {channel.unit for channel in described.channels[3:]} == {"Nm"}
    half_x_mm = (described.corners[1].x - described.corners[0].x) / 2
    half_y_mm = (described.corners[2].y - described.corners[1].y) / 2
    steps = steps_on(scene, plate)
    assert len(steps) >= 3
    for step in steps:
        fx, fy, fz, mx, my, mz = step.T
        third = len(step) // 3
        assert 800 < np.max(fz[:third]) < 950
        assert 500 < np.min(fz[third:-third]) < 700
        assert 800 < np.max(fz[-third:]) < 950
        x_mm, y_mm = -1000 * my / fz, 1000 * mx / fz
        assert np.all(np.abs(x_mm) < half_x_mm)
        assert np.all(np.abs(y_mm) < half_y_mm)
        assert np.all(np.diff(y_mm) > 0)
        assert y_mm[-1] - y_mm[0] > 150
        free_moment_nm = mz - (x_mm * fy - y_mm * fx) / 1000
        assert np.max(np.abs(free_moment_nm)) == pytest.approx(3.0, abs=0.05)


def test_a_button_is_pressed_and_released_every_second(scene: SyntheticScene) -> None:
    events = scene.events(0, 3_000_000)
    buttons = ((0, 1), (1_000_000, 2), (2_000_000, 1))
    presses = [(from_us + us, n, down) for from_us, n in buttons for us, down in ((500_000, 1), (800_000, 0))]
    assert [tuple(event) for event in events.tolist()] == [(BUTTON_EVENT, *each, -1) for each in presses]
    assert scene.parameters.events is not None
    assert [int(event.id, 0) for event in scene.parameters.events.events] == [BUTTON_EVENT]


@given(
    times_us=st.lists(st.integers(0, 50).map(lambda tenths: 100_000 * tenths), min_size=2, max_size=6).map(
        sorted
    )
)
def test_events_do_not_depend_on_how_the_time_is_divided(times_us: list[int]) -> None:
    scene = SyntheticScene(markers=0, tools=0, analog=0, plates=0)
    parts = [scene.events(a, b).tolist() for a, b in pairwise(times_us)]
    whole = scene.events(times_us[0], times_us[-1]).tolist()
    assert [event for part in parts for event in part] == whole
    assert all(times_us[0] <= event[1] < times_us[-1] for event in whole)


@settings(max_examples=examples(30))
@given(*[st.integers(0, most) for most in (30, 12, 5, 3, 99)])
def test_parameters_describe_any_scene(markers: int, tools: int, analog: int, plates: int, seed: int) -> None:
    """Clients allocate by the parameters; labels have a word and a number, and tools name their markers."""
    scene = SyntheticScene(markers=markers, tools=tools, analog=analog, plates=plates, seed=seed)
    counts = dict(zip(COUNTED, (markers, tools, analog, plates), strict=True))
    described = {kind: num_described_items(scene.parameters, kind) for kind in counts}
    assert described == counts
    assert set(scene.rates_hz) == {component for component, count in counts.items() if count}
    for component in scene.rates_hz:
        items = scene.items(component, np.arange(5, 12))
        assert items.shape == (7, counts[component])
        assert items.dtype == ITEM_DTYPES[component]
    assert described_labels(scene.parameters, ComponentType.MARKERS) == [
        f"Marker {number}" for number in range(1, markers + 1)
    ]
    assert scene.parameters.tools is not None
    known = {str(number) for number in range(1, markers + 1)}
    assert all(known.issuperset(tool.marker_ids) for tool in scene.parameters.tools.tools)
