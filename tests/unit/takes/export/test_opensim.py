"""Export for OpenSim. ``make opensim`` reads the same files with OpenSim itself."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
import trc
from lxml import etree

from gateway.errors import SelectionError, TakeError
from gateway.rtc3d.components import ComponentType
from gateway.rtc3d.parameters import (
    AnalogChannel,
    ForceChannel,
    Parameters,
    ParametersAnalog,
    ParametersForce,
    Plate,
    Point,
)
from gateway.simulator.c3d_scene import C3dScene
from gateway.simulator.synthetic import SyntheticScene
from gateway.takes.export.job import Axis, ExportJob, OpenSimOptions, export_take
from tests.support.errors import each_names, names, one_names, raises
from tests.support.takes import (
    START_UTIME,
    Message,
    description,
    frame,
    parameters,
    record_scene,
    scene_messages,
)
from tests.unit.takes.export.exported import (
    NAN,
    SCENE,
    export_messages,
    labelled,
    notes_of,
    read_ezc3d,
    samples,
    scene,
)
from tests.unit.takes.export.test_trc import read_trc

Values = npt.NDArray[Any]


class Storage(NamedTuple):
    """The content of a .mot or .sto file; ``values`` has the shape (rows, labels), without the times."""

    header: dict[str, str]
    labels: list[str]
    times_s: Values
    values: Values

    def columns(self, *names: str) -> Values:
        """Return the values of columns, shape (rows, names)."""
        return self.values[:, [self.labels.index(name) for name in names]]


def read_storage(path: Path) -> Storage:
    head, _, body = path.read_text().partition("endheader\n")
    name, *lines = head.splitlines()
    assert name == path.stem
    header = dict(line.split("=", 1) for line in lines)
    first, *_ = body.splitlines()
    time, *labels = first.split("\t")
    assert time == "time"
    rows = np.loadtxt(body.splitlines()[1:], delimiter="\t", ndmin=2)
    assert rows.shape == (int(header["nRows"]), int(header["nColumns"]))
    assert (header["version"], header["inDegrees"]) == ("1", "no")
    return Storage(header, labels, rows[:, 0], rows[:, 1:])


def vectors_of(found: Storage, plate: int) -> tuple[Values, Values, Values]:
    """Return forces, positions and free moments of a plate, each of shape (rows, 3)."""
    names = (f"ground_force_{plate}_v", f"ground_force_{plate}_p", f"ground_torque_{plate}_")
    force, position, moment = (found.columns(*(f"{name}{axis}" for axis in "xyz")) for name in names)
    return force, position, moment


@pytest.mark.takes
def test_a_real_recording_gives_what_ezc3d_reads_and_computes(tmp_path: Path) -> None:
    """Markers and channels are equal; force, centre of pressure and free moment within 0.1 mm and 0.1 mNm."""
    original = Path(os.environ["RTC3D_TAKES"]) / "qualisys.c3d"
    take = record_scene(tmp_path / "gait.lcmlog", C3dScene(original), 340)
    job = ExportJob(take, tmp_path / "out", "opensim")
    assert [path.name for path in export_take(job)] == ["gait.trc", "gait.mot", "gait.xml", "gait.sto"]
    expected = read_ezc3d(original)["data"]

    def rotated(vectors: Values) -> Values:  # of shape (3, …), from Z up
        return np.stack([vectors[0], vectors[2], -vectors[1]], axis=-1)

    markers = trc.TRCData()
    markers.load(str(tmp_path / "out/gait.trc"))
    found = np.array([markers[label] for label in markers["Markers"]])
    points = rotated(expected["points"][:3].astype(np.float32).astype(float))
    assert markers["Units"] == "m"
    assert np.array_equal((found * 1000).astype(np.float32), points.astype(np.float32))

    channels = read_storage(tmp_path / "out/gait.sto")
    assert np.array_equal(channels.values.T.astype(np.float32), expected["analogs"][0].astype(np.float32))

    reactions = read_storage(tmp_path / "out/gait.mot")
    assert len(reactions.times_s) == 3400
    assert np.diff(reactions.times_s) == pytest.approx(1 / 2000, abs=2e-6)
    assert reactions.times_s[0] == pytest.approx(markers["Time"][0], abs=1e-6)
    for number, plate in enumerate(expected["platform"], start=1):
        force, position, moment = vectors_of(reactions, number)
        has_contact = abs(plate["force"][2]) >= 10
        assert 1000 < has_contact.sum() < 3000
        assert force[has_contact] == pytest.approx(rotated(plate["force"])[has_contact], abs=1e-4)
        centre = rotated(plate["center_of_pressure"]) / 1000
        assert position[has_contact] == pytest.approx(centre[has_contact], abs=1e-4)
        assert moment[has_contact] == pytest.approx(rotated(plate["Tz"])[has_contact] / 1000, abs=1e-4)
        assert not force[~has_contact].any()
        assert not moment[~has_contact].any()


NEWTONS = tuple(ForceChannel(str(n), unit="N" if n < 3 else "Nm") for n in range(6))
PLATE = Plate(
    "1",
    "left",
    frequency_hz=100.0,
    corners=(Point(400, 600, 0), Point(0, 600, 0), Point(0, 0, 0), Point(400, 0, 0)),
    channels=NEWTONS,
)
STEP = (10.0, 20.0, 800.0, 80.0, -40.0, 0.5)
"""A load about the centre, (0.2, 0.3, 0) m. It acts 0.05 m from it along x, and 0.1 m along y."""


def step_messages(*loads: tuple[float, ...], plate: Plate = PLATE) -> list[Message]:
    rows = (frame(ComponentType.FORCE, [load], number) for number, load in enumerate(loads))
    return [description(), parameters(Parameters(force=ParametersForce((plate,)))), *rows]


def test_ground_reactions_worked_out_by_hand(tmp_path: Path) -> None:
    """r = (0.05, 0.1, 0), F = (10, 20, 800): the moment about z is 0.5 - (0.05 · 20 - 0.1 · 10) = 0.5 Nm."""
    job = export_messages(tmp_path, step_messages(STEP, (0, 0, 9.5, 1, 1, 1), STEP), "walk.mot")
    force, position, moment = vectors_of(read_storage(tmp_path / "walk.mot"), 1)
    assert force.tolist() == [[10, 800, -20], [0, 0, 0], [10, 800, -20]]
    assert position == pytest.approx(np.array([[0.25, 0, -0.4], [0.2, 0, -0.3], [0.25, 0, -0.4]]))
    assert moment == pytest.approx(np.array([[0, 0.5, 0], [0, 0, 0], [0, 0.5, 0]]))
    rotated = "axes rotated: X is x, Y is z, Z is -y of the server; z is up by the plates"
    assert each_names(
        notes_of(job), [f"walk.mot | {rotated}"], ["walk.mot", "plate 1", "10 N", "1 of 3 samples"]
    )


@pytest.mark.parametrize(
    ("unit", "moment_unit", "factors"),
    [("N", "Nmm", (1, 1000)), ("kN", "kNm", (0.001, 0.001)), ("kN", "Nm", (0.001, 1))],
)
def test_units_of_the_server_become_newtons_and_metres(
    tmp_path: Path, unit: str, moment_unit: str, factors: tuple[float, float]
) -> None:
    channels = tuple(replace(each, unit=unit if n < 3 else moment_unit) for n, each in enumerate(NEWTONS))
    load = tuple(value * factors[n > 2] for n, value in enumerate(STEP))
    messages = step_messages(load, plate=replace(PLATE, channels=channels))
    job = export_messages(tmp_path, messages, "walk.mot")
    assert one_names(notes_of(job), "forces", "N.m")
    [force], [position], [moment] = vectors_of(read_storage(tmp_path / "walk.mot"), 1)
    assert force == pytest.approx([10, 800, -20])
    assert position == pytest.approx([0.25, 0, -0.4])
    assert moment == pytest.approx([0, 0.5, 0], abs=1e-6)


def test_unknown_units_of_a_plate_are_reported(tmp_path: Path) -> None:
    channels = tuple(replace(each, unit="lb" if n < 3 else "lb.in") for n, each in enumerate(NEWTONS))
    job = export_messages(tmp_path, step_messages(STEP, plate=replace(PLATE, channels=channels)), "walk.mot")
    assert one_names(notes_of(job), "plates", "lb, lb.in", "N.mm")


def test_positions_in_metres_are_not_converted(tmp_path: Path) -> None:
    messages = [labelled("a", unit="m"), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])]
    job = export_messages(tmp_path, messages, "out", format="opensim")
    assert "converted" not in "".join(notes_of(job, usual=True))


def test_forces_on_the_plate_become_those_on_the_person(tmp_path: Path) -> None:
    """A person pushes down, and the ground pushes back."""
    down = tuple(-value for value in STEP)
    job = export_messages(tmp_path, step_messages(down), "walk.mot")
    [force], [position], [moment] = vectors_of(read_storage(tmp_path / "walk.mot"), 1)
    assert force.tolist() == [10, 800, -20]
    assert position == pytest.approx([0.25, 0, -0.4])
    assert moment == pytest.approx([0, 0.5, 0])
    reversed_row = "walk.mot | plate 1: forces reversed, because those on the plate were recorded"
    assert reversed_row in notes_of(job)


def test_the_offset_of_an_empty_plate_does_not_reverse_the_forces_of_a_step(tmp_path: Path) -> None:
    offset = (0.0, 0.0, -15.0, 0.0, 0.0, 0.0)
    export_messages(tmp_path, step_messages(*[offset] * 100, STEP), "walk.mot")
    assert vectors_of(read_storage(tmp_path / "walk.mot"), 1)[0][:, 1].tolist() == [0] * 100 + [800]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_force_that_would_pull_at_the_plate_is_no_contact(tmp_path: Path, sign: float) -> None:
    """Whether the forces on the person or those on the plate were recorded; the note does not count it."""
    loads = [tuple(sign * value for value in load) for load in (STEP, (0, 0, -20, 1, 1, 1), STEP)]
    job = export_messages(tmp_path, step_messages(*loads), "walk.mot")
    force, position, moment = vectors_of(read_storage(tmp_path / "walk.mot"), 1)
    assert force[:, 1].tolist() == [800, 0, 800]
    assert position[1] == pytest.approx([0.2, 0, -0.3])
    assert not moment[1].any()
    assert one_names(notes_of(job), "plate 1: no contact", "1 of 3 samples")


def pressed(*newtons: float, rate_hz: float) -> list[Message]:
    """Return forces at a right angle to the plate; NaN is a sample that was not measured."""
    loads = [(0.0, 0.0, force, 0.0, 0.0, 0.5) for force in newtons]
    plate = replace(PLATE, frequency_hz=rate_hz)
    messages = [description(), parameters(Parameters(force=ParametersForce((plate,))))]
    for number, load in enumerate(loads):
        time_us = round(number * 1e6 / rate_hz)
        utime = START_UTIME + time_us
        messages.append(frame(ComponentType.FORCE, [load], number, timestamp_us=time_us, utime=utime))
    return messages


@pytest.mark.parametrize(
    ("rate_hz", "num_samples", "has_contact"),
    [
        (1000, 1, False),
        (1000, 9, False),
        (1000, 10, True),
        (2000, 19, False),
        (2000, 20, True),
        (100, 1, True),
        (30, 1, True),
    ],
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("place", [0, 50, 3995, 4195])
def test_a_force_of_less_than_10_ms_is_no_contact(
    tmp_path: Path, rate_hz: float, num_samples: int, has_contact: bool, sign: float, place: int
) -> None:
    """Also where one block of samples ends and the next begins, and at both ends of the take."""
    forces = np.zeros(4200)
    forces[100:200] = 800
    place = min(place, len(forces) - num_samples)
    forces[place : place + num_samples] = 20
    job = export_messages(tmp_path, pressed(*(sign * forces), rate_hz=rate_hz), "walk.mot")
    force, position, moment = vectors_of(read_storage(tmp_path / "walk.mot"), 1)
    expected = forces if has_contact else np.where(forces == 20, 0, forces)
    assert np.array_equal(force[:, 1], expected)
    assert np.array_equal(moment[:, 1] != 0, expected != 0)
    assert position == pytest.approx(np.tile([0.2, 0, -0.3], (4200, 1)))
    num_empty = np.count_nonzero(expected == 0)
    assert one_names(notes_of(job), "plate 1: no contact", "10 ms", f"{num_empty} of 4200 samples")


def test_samples_that_are_missing_do_not_end_a_contact(tmp_path: Path) -> None:
    """Every fifth sample of a step and of a spike is missing: the step stays, the spike does not."""
    forces = np.zeros(300)
    forces[100:200], forces[250:258] = 800, 20
    forces[::5] = NAN
    export_messages(tmp_path, pressed(*forces, rate_hz=1000), "walk.mot")
    found = vectors_of(read_storage(tmp_path / "walk.mot"), 1)[0][:, 1]
    known = forces[~np.isnan(forces)]
    assert np.array_equal(found, np.where(known == 800, 800, 0))


def test_the_limit_of_contact_is_chosen(tmp_path: Path) -> None:
    messages = step_messages(STEP, (0, 0, 9.5, 0, 0, 1))
    export_messages(tmp_path, messages, "walk.mot", opensim=OpenSimOptions(min_force_n=9.5))
    assert vectors_of(read_storage(tmp_path / "walk.mot"), 1)[0][:, 1].tolist() == [800, 9.5]


def test_samples_that_are_missing_have_no_row(tmp_path: Path) -> None:
    """OpenSim reads NaN as a number; it interpolates between rows, whose times need not be regular."""
    lost = {7, 8}

    def keep(component: ComponentType, sample: int) -> bool:
        return component not in {ComponentType.FORCE, ComponentType.ANALOG} or sample not in lost

    messages = scene(20, keep=keep)
    job = export_messages(tmp_path, messages, "out", format="opensim")
    rows = [row for row in range(200) if row not in lost]
    reactions, channels = (read_storage(tmp_path / "out" / name) for name in ("take.mot", "take.sto"))
    for name, found in (("take.mot", reactions), ("take.sto", channels)):
        assert found.times_s - found.times_s[0] == pytest.approx(np.array(rows) / 1000, abs=2e-6)
        assert one_names(notes_of(job), name, "2 of 200")
    assert np.array_equal(channels.values.T.astype(np.float32), samples(0, 200)[:, rows].astype(np.float32))
    times_s = read_trc(tmp_path / "out/take.trc").times_s
    assert channels.times_s[0] == pytest.approx(times_s[0], abs=1e-6)


def test_channels_are_written_as_they_were_recorded(tmp_path: Path) -> None:
    values = [[1.5, NAN, -1e-7], [NAN, NAN, NAN], [0, 3e38, 1 / 3]]
    messages = [frame(ComponentType.ANALOG, row, number) for number, row in enumerate(values)]
    job = export_messages(tmp_path, [description(), *messages], "emg.sto")
    found = read_storage(tmp_path / "emg.sto")
    assert found.labels == ["channel_1", "channel_2", "channel_3"]
    assert found.header["units"] == "mV"
    assert np.array_equal(
        found.values.astype(np.float32), np.array(values, np.float32)[[0, 2]], equal_nan=True
    )
    assert one_names(notes_of(job), "emg.sto", "1 of 3")


def test_samples_outside_the_frames_and_other_components_are_reported(tmp_path: Path) -> None:
    def keep(component: ComponentType, sample: int) -> bool:
        return component is not ComponentType.MARKERS or sample >= 5

    shown = SyntheticScene(markers=5, tools=1, analog=3, plates=2, rate_hz=100, analog_rate_hz=1000)
    job = export_messages(tmp_path, scene(20, shown, keep=keep), "out", format="opensim")
    notes = notes_of(job, usual=True)
    assert one_names(notes, "rows", "force", "lab", "50 of 200")
    assert one_names(notes, "rows", "analog", "lab", "50 of 200")
    assert one_names(notes, "left out", "lab", "tools (6D)", "markers")
    assert one_names(notes, "mm to m")


def test_a_rate_that_is_no_multiple_is_reported_and_a_file_of_its_own_has_it(tmp_path: Path) -> None:
    odd = SyntheticScene(markers=2, tools=0, analog=3, plates=1, rate_hz=100, analog_rate_hz=250)
    job = export_messages(tmp_path, scene(50, odd), "out", format="opensim")
    assert [path.name for path in job.files.paths] == ["take.trc"]
    for key, extension in (("force", ".mot"), ("analog", ".sto")):
        note = (
            f"{key} left out: its rate is not a multiple of that of the frames; export to {extension} has it"
        )
        assert note in notes_of(job)
    export_messages(tmp_path, scene(50, odd), "walk.mot")
    assert len(read_storage(tmp_path / "walk.mot").times_s) == 125


def test_forces_with_another_rate_than_the_plates_own_channels_have_all_their_samples(tmp_path: Path) -> None:
    """Channels of 100 Hz give the same load, but only every second sample."""
    channels = tuple(AnalogChannel(str(n), f"c{n}", frequency_hz=100.0) for n in range(6))
    plate = replace(PLATE, frequency_hz=200.0, analog_channel_ids=tuple("012345"))
    described = Parameters(analog=ParametersAnalog(channels), force=ParametersForce((plate,)))
    load_nmm = (*STEP[:3], *(1000 * moment for moment in STEP[3:]))
    messages = [description(), parameters(described)]
    for number in range(20):
        time_us, utime = 5000 * number, START_UTIME + 5000 * number
        messages.append(frame(ComponentType.FORCE, [STEP], number, timestamp_us=time_us, utime=utime))
        if number % 2 == 0:
            row = number // 2
            messages.append(frame(ComponentType.ANALOG, load_nmm, row, timestamp_us=time_us, utime=utime))
    export_messages(tmp_path, messages, "out", format="opensim")
    found = read_storage(tmp_path / "out/take.mot")
    assert len(found.times_s) == 20
    assert vectors_of(found, 1)[0].tolist() == [[10, 800, -20]] * 20


AXES: list[tuple[Axis | None, Axis | None, str]] = [
    (None, None, "x z -y"),  # a guess: there are no plates
    ("y", None, "x y z"),
    ("x", None, "z x y"),
    ("-z", None, "x -z y"),
    ("-x", None, "z -x -y"),
    ("z", "y", "y z x"),
    ("z", "-x", "-x z y"),
    (None, "-y", "-y z -x"),
]


@pytest.mark.parametrize(("up", "forward", "expected"), AXES)
def test_axes_are_chosen(tmp_path: Path, up: Axis | None, forward: Axis | None, expected: str) -> None:
    messages = [labelled("a", unit="mm"), frame(ComponentType.MARKERS, [(1, 2, 3, 0)])]
    chosen = OpenSimOptions(up, forward)
    job = export_messages(tmp_path, messages, "out", format="opensim", opensim=chosen)
    values = {"x": 1, "y": 2, "z": 3, "-x": -1, "-y": -2, "-z": -3}
    position = [values[axis] / 1000 for axis in expected.split()]
    assert read_trc(tmp_path / "out/take.trc").positions[0, 0].tolist() == pytest.approx(position)
    assert names(notes_of(job)[0], "guess") is (up is None)
    alone = export_messages(tmp_path, messages, "alone.trc", opensim=chosen)
    found = read_trc(tmp_path / "alone.trc")
    is_chosen = chosen.has_axes
    assert found.header["Units"] == "mm"  # without --opensim, the unit stays
    assert found.positions[0, 0].tolist() == ([1000 * each for each in position] if is_chosen else [1, 2, 3])
    assert bool(notes_of(alone)) is is_chosen


def test_one_axis_cannot_point_up_and_forward(tmp_path: Path) -> None:
    messages = step_messages(STEP)
    with raises(SelectionError, "--forward", "-z"):
        export_messages(tmp_path, messages, "walk.mot", opensim=OpenSimOptions(forward="-z"))


def test_external_loads_refer_to_the_columns_and_bodies(tmp_path: Path) -> None:
    chosen = OpenSimOptions(bodies=("calcn_l", "board & deck"))
    export_messages(tmp_path, scene(10), "out", format="opensim", opensim=chosen)
    loads = etree.parse(tmp_path / "out/take.xml").find("ExternalLoads")
    assert loads is not None
    assert loads.findtext("datafile") == "take.mot"
    labels = read_storage(tmp_path / "out/take.mot").labels
    forces = loads.findall("objects/ExternalForce")
    assert [force.findtext("applied_to_body") for force in forces] == ["calcn_l", "board & deck"]
    for force in forces:
        for name in ("force", "point", "torque"):
            identifier = force.findtext(f"{name}_identifier")
            assert {f"{identifier}{axis}" for axis in "xyz"} <= set(labels)


def test_bodies_are_guessed_and_reported_or_as_many_as_the_plates(tmp_path: Path) -> None:
    job = export_messages(tmp_path, scene(10), "out", format="opensim")
    guess = "take.xml | which foot is on which plate is a guess: calcn_r, calcn_l; choose with --bodies"
    assert f"{guess} | 2" in notes_of(job)
    with raises(SelectionError, "take.mot: 2, not 1"):
        export_messages(tmp_path, scene(10), "b", format="opensim", opensim=OpenSimOptions(bodies=("a",)))
    assert not (tmp_path / "b").exists()


def test_a_folder_that_exists_keeps_what_is_in_it(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out/take.mot").write_text("mine")
    with raises(TakeError, "take.mot", "exists already"):
        export_messages(tmp_path, scene(10), "out", format="opensim")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["take.mot"]
    (tmp_path / "out/take.mot").unlink()
    export_messages(tmp_path, scene(10), "out", format="opensim")


def test_each_measurement_has_its_own_files(tmp_path: Path) -> None:
    messages = [*scene(10), *scene_messages(SCENE, 10, start_us=60_000_000, sequence=10_000)]
    job = export_messages(tmp_path, messages, "out", format="opensim")
    names = [f"take-{number}{end}" for number in (1, 2) for end in (".trc", ".mot", ".xml", ".sto")]
    assert [path.name for path in job.files.paths] == names
    first, second = (read_storage(tmp_path / f"out/take-{number}.mot") for number in (1, 2))
    assert second.times_s[0] - first.times_s[0] == pytest.approx(60, abs=0.001)


@pytest.mark.parametrize("name", ["walk.mot", "walk.sto"])
def test_a_take_without_loads_or_channels_is_an_error(tmp_path: Path, name: str) -> None:
    plate = replace(PLATE, corners=())
    messages = step_messages(STEP, plate=plate) if name == "walk.mot" else [description(), labelled("a")]
    with pytest.raises(TakeError, match=rf"take\.lcmlog .*no .*\{name[4:]}"):
        export_messages(tmp_path, messages, name)
