"""A person who walks over two force plates: the scene of the sample files, made from simple curves.

Positions are in mm. The person walks along +Y, +X is to the right and +Z is up. Each foot is on the ground
for 0.72 s of a stride of 1.2 s. The knee follows from the hip and the ankle.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from gateway.rtc3d.components import ITEM_DTYPES, LONG_EVENT, MISSING, MISSING_MARKER, ComponentType, Items
from gateway.rtc3d.parameters import (
    AnalogChannel,
    EventDefinition,
    EventParameter,
    ExpectedValue,
    Marker,
    Parameters,
    Parameters3D,
    Parameters6D,
    ParametersAnalog,
    ParametersEvents,
    Tool,
)
from gateway.session.server.measurement import ComputedScene
from gateway.session.server.scene import SampleNumbers
from gateway.simulator.bodies import ForcePlates, Noise

Floats = npt.NDArray[np.float64]

SECONDS: Final = 5.0
RATE_HZ: Final = 50.0
ANALOG_RATE_HZ: Final = 200.0
FOOT_STRIKE: Final = 0x101
"""The id of the event. param1 is 1 for the left foot and 2 for the right one, param2 the plate or 0."""

STRIDE_S: Final = 1.2
STRIDE_MM: Final = 1220.0  # two plates are 610 mm apart
STANCE: Final = 0.6  # the share of the stride in which a foot is on the ground
FIRST_STRIKE_S: Final = {"R": 0.0, "L": 0.6}
PLATE_STRIKES_S: Final = (2.4, 3.0)  # of the right foot on the first plate and of the left foot on the second
ANKLE_ON_PLATE_MM: Final = 240.0  # the right ankle, while the foot is on the first plate
LINE_MM: Final = 200.0  # x of the middle of the body, which is that of the plates
SIDES: Final = {"L": -1.0, "R": 1.0}

THIGH_MM: Final = 450.0
SHANK_MM: Final = 430.0
UPPER_ARM_MM: Final = 300.0
FOREARM_MM: Final = 260.0

HIDDEN_S: Final = {  # when markers are out of view, from and to
    "RWRA": [(0.9, 1.1), (2.1, 2.35), (3.3, 3.5)],
    "RASI": [(0.5, 0.6), (1.7, 1.85), (4.1, 4.2)],
    "LHEE": [(1.3, 1.36), (3.7, 3.78)],
    "LANK": [(2.7, 3.3)],
    "LTOE": [(2.9, 3.1)],
    "T10": [(4.2, 4.8)],
}


def _eased(time: Floats, times: list[float], values: list[float]) -> Floats:
    """Return the value at each time; between two given times, it goes smoothly from one value to the next."""
    place = np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2)
    start, stop = np.take(times, place), np.take(times, place + 1)
    share = np.clip((time - start) / (stop - start), 0, 1)
    ease = share * share * (3 - 2 * share)
    eased: Floats = np.take(values, place) * (1 - ease) + np.take(values, place + 1) * ease
    return eased


def _point(x: Floats | float, y: Floats | float, z: Floats | float) -> Floats:
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1).astype(np.float64)


def _pitched(angle: Floats, forward: float, up: float) -> tuple[Floats, Floats]:
    """Return y and z of a point on a body that is turned about the X axis; positive angles lift its front."""
    return forward * np.cos(angle) - up * np.sin(angle), forward * np.sin(angle) + up * np.cos(angle)


class _Foot:
    """The ankle and the pitch of a foot, as functions of time."""

    BALL_MM = (140.0, -70.0)
    """Where the ball of the foot is, forward and up from the ankle. The foot turns about it at the end."""

    def __init__(self, side: str) -> None:
        self._first_strike_s = FIRST_STRIKE_S[side]
        strides = (PLATE_STRIKES_S[0] - self._first_strike_s) / STRIDE_S
        self._first_y_mm = ANKLE_ON_PLATE_MM - strides * STRIDE_MM
        self.x_mm = LINE_MM + 60.0 * SIDES[side]

    def __call__(self, time_s: Floats) -> tuple[Floats, Floats]:
        """Return the position of the ankle, shape (count, 3), and the pitch in radians, shape (count,)."""
        strides = (time_s - self._first_strike_s) / STRIDE_S
        number = np.floor(strides)
        phase = strides - number
        pitch = np.radians(_eased(phase, [0, 0.08, 0.38, 0.62, 0.9, 1], [18, 0, 0, -55, 18, 18]))
        ball_y, ball_z = self.BALL_MM
        back_y, back_z = _pitched(np.minimum(pitch, 0), -ball_y, -ball_z)
        y = self._first_y_mm + number * STRIDE_MM
        swing = np.clip((phase - STANCE) / (1 - STANCE), 0, 1)
        forward = swing * swing * (3 - 2 * swing) * STRIDE_MM
        # While the foot stands, the ball stays where it is; in the swing, the ankle rises a little.
        heel_first = 20.0 * np.maximum(pitch, 0)
        return _point(
            self.x_mm,
            y + ball_y + back_y + forward,
            90.0 + ball_z + back_z + heel_first + 45.0 * np.sin(np.pi * swing) ** 2,
        ), pitch


class Body:
    """The positions of the markers, and the poses of the tools."""

    def __init__(self) -> None:
        self._feet = {side: _Foot(side) for side in SIDES}

    def markers(self, time_s: Floats) -> dict[str, Floats]:
        """Return the position of each marker, shape (count, 3)."""
        found: dict[str, Floats] = {}
        gait = 2 * np.pi * time_s / STRIDE_S  # 0 when the right foot strikes
        pelvis = self._pelvis(time_s)
        turn = np.radians(6.0) * np.cos(
            gait
        )  # of the pelvis: the right hip is forward when the right foot strikes
        chest_turn = -np.radians(9.0) * np.cos(gait)

        def around(centre: Floats, angle: Floats, right: float, forward: float, up: float) -> Floats:
            return centre + _point(
                right * np.cos(angle) - forward * np.sin(angle),
                right * np.sin(angle) + forward * np.cos(angle),
                up,
            )

        for side, sign in SIDES.items():
            found[f"{side}ASI"] = around(pelvis, turn, 125 * sign, 95, 70)
            found[f"{side}PSI"] = around(pelvis, turn, 50 * sign, -110, 80)
        chest = pelvis + _point(0, 15, 330)
        found["C7"] = around(chest, chest_turn, 0, -75, 190)
        found["T10"] = around(chest, chest_turn, 0, -105, -20)
        found["CLAV"] = around(chest, chest_turn, 0, 60, 120)
        found["STRN"] = around(chest, chest_turn, 0, 95, -30)
        head = self._head(pelvis)
        for side, sign in SIDES.items():
            found[f"{side}FHD"] = head + _point(70 * sign, 90, 20)
            found[f"{side}BHD"] = head + _point(65 * sign, -85, 30)
            shoulder = around(chest, chest_turn, 185 * sign, -5, 140)
            found[f"{side}SHO"] = shoulder + _point(0, 0, 35)
            found |= self._arm(side, sign, shoulder, gait)
            hip = around(pelvis, turn, 90 * sign, 20, -20)
            found |= self._leg(side, sign, hip, time_s)
        return found

    def tools(self, time_s: Floats) -> dict[str, tuple[Floats, Floats]]:
        """Return the position of each tool, shape (count, 3), and its turn about the X axis in radians."""
        pelvis = self._pelvis(time_s)
        nod = np.radians(3.0) * np.sin(4 * np.pi * time_s / STRIDE_S)
        feet = {"Left foot": self._feet["L"](time_s), "Right foot": self._feet["R"](time_s)}
        return {"Head": (self._head(pelvis), nod), **feet}

    @staticmethod
    def _pelvis(time_s: Floats) -> Floats:
        """Return the middle between the hips; it is lowest when both feet are on the ground."""
        gait = 2 * np.pi * time_s / STRIDE_S
        y = ANKLE_ON_PLATE_MM - 330 + (time_s - PLATE_STRIKES_S[0]) * STRIDE_MM / STRIDE_S
        return _point(LINE_MM + 22 * np.sin(gait), y + 8 * np.sin(2 * gait), 880 - 18 * np.cos(2 * gait))

    @staticmethod
    def _head(pelvis: Floats) -> Floats:
        return pelvis + _point(0, 45, 690)

    @staticmethod
    def _arm(side: str, sign: float, shoulder: Floats, gait: Floats) -> dict[str, Floats]:
        """Return the markers of an arm, which swings against the leg of its side."""
        upper = np.radians(2 - 22 * sign * np.cos(gait))
        bend = np.radians(22 - 12 * sign * np.cos(gait))
        elbow = shoulder + _point(35 * sign, UPPER_ARM_MM * np.sin(upper), -UPPER_ARM_MM * np.cos(upper))
        hand_y, hand_z = np.sin(upper + bend), -np.cos(upper + bend)
        wrist = elbow + _point(5 * sign, FOREARM_MM * hand_y, FOREARM_MM * hand_z)
        return {
            f"{side}ELB": elbow + _point(30 * sign, 0, 0),
            f"{side}WRA": wrist + _point(-5 * sign, 32, 10),
            f"{side}WRB": wrist + _point(15 * sign, -30, -5),
            f"{side}FIN": wrist + _point(10 * sign, 85 * hand_y, 85 * hand_z),
        }

    def _leg(self, side: str, sign: float, hip: Floats, time_s: Floats) -> dict[str, Floats]:
        """Return the markers of a leg; the knee is where thigh and shank meet, in front."""
        ankle, pitch = self._feet[side](time_s)
        reach = ankle - hip
        distance = np.minimum(np.linalg.norm(reach[:, 1:], axis=1), THIGH_MM + SHANK_MM - 0.5)
        along = (THIGH_MM**2 - SHANK_MM**2 + distance**2) / (2 * distance)
        across = np.sqrt(THIGH_MM**2 - along**2)
        direction = reach[:, 1:] / np.linalg.norm(reach[:, 1:], axis=1, keepdims=True)
        knee = hip + _point(
            reach[:, 0] / 2,
            direction[:, 0] * along - direction[:, 1] * across,
            direction[:, 1] * along + direction[:, 0] * across,
        )
        heel, toe = _pitched(pitch, -70.0, -55.0), _pitched(pitch, 150.0, -55.0)
        return {
            f"{side}THI": (hip + knee) / 2 + _point(75 * sign, 10, 0),
            f"{side}KNE": knee + _point(50 * sign, 0, 0),
            f"{side}TIB": (knee + ankle) / 2 + _point(50 * sign, 15, 0),
            f"{side}ANK": ankle + _point(38 * sign, 0, 0),
            f"{side}HEE": ankle + _point(0, *heel),
            f"{side}TOE": ankle + _point(5 * sign, *toe),
        }


class WalkingPerson(ComputedScene):
    """A walk of SECONDS: markers, three tools, the EMG of four muscles, two force plates, strikes of feet."""

    num_frames = int(SECONDS * RATE_HZ)
    measurement_rate_hz = RATE_HZ

    def __init__(self) -> None:
        rng = np.random.default_rng(1)
        self._body = Body()
        self._labels = [*self._body.markers(np.zeros(1))]
        self._plates = ForcePlates(len(PLATE_STRIKES_S), ANALOG_RATE_HZ, rng)
        self._marker_noise = Noise(rng, 3 * len(self._labels))
        self._muscle_noise = Noise(rng, len(_MUSCLES))
        self._items: dict[ComponentType, Callable[[SampleNumbers], Items]] = {
            ComponentType.MARKERS: self._markers,
            ComponentType.TOOLS: self._tools,
            ComponentType.ANALOG: self._muscles,
            ComponentType.FORCE: self._forces,
        }
        slow, fast = RATE_HZ, ANALOG_RATE_HZ
        self.rates_hz = dict(zip(self._items, (slow, slow, fast, fast), strict=True))
        ids = {label: str(number) for number, label in enumerate(self._labels, start=1)}
        self.parameters = Parameters(
            markers=Parameters3D(
                frequency_hz=slow, markers=tuple(Marker(ids[label], label) for label in self._labels)
            ),
            tools=Parameters6D(
                frequency_hz=slow,
                tools=tuple(
                    Tool(str(number), name, marker_ids=tuple(ids[label] for label in labels))
                    for number, (name, labels) in enumerate(_TOOLS.items(), start=1)
                ),
            ),
            analog=ParametersAnalog(
                tuple(
                    AnalogChannel(str(number), name, unit="mV", frequency_hz=fast)
                    for number, (name, *_) in enumerate(_MUSCLES, start=1)
                )
            ),
            force=self._plates.parameters,
            events=_EVENTS,
        )

    def items(self, component: ComponentType, samples: SampleNumbers) -> Items:
        """See ComputedScene."""
        length = round(SECONDS * self.rates_hz[component])
        return self._items[component](samples % length)

    def events(self, start_us: int, stop_us: int) -> Items:
        """See ComputedScene. Each strike of a foot is an event."""
        strikes = [
            (first_s + number * STRIDE_S, foot)
            for foot, first_s in enumerate((FIRST_STRIKE_S["L"], FIRST_STRIKE_S["R"]), start=1)
            for number in range(int(SECONDS / STRIDE_S) + 1)
        ]
        found = [
            (FOOT_STRIKE, round(time_s * 1_000_000), foot, _plate_number(time_s), -1)
            for time_s, foot in sorted(strikes)
            if start_us <= round(time_s * 1_000_000) < min(stop_us, SECONDS * 1_000_000)
        ]
        events = np.zeros(len(found), LONG_EVENT)
        for name, values in zip(
            ("id", "timestamp", "param1", "param2", "param3"), zip(*found, strict=True), strict=False
        ):
            events[name] = values
        return events

    def _markers(self, samples: SampleNumbers) -> Items:
        time_s = samples / RATE_HZ
        noise_mm = 0.2 * self._marker_noise(samples).reshape(len(samples), -1, 3)
        values = np.empty((len(samples), len(self._labels), 4), np.float32)
        values[..., :3] = np.stack([*self._body.markers(time_s).values()], axis=1) + noise_mm
        values[..., 3] = np.linalg.norm(noise_mm, axis=2)
        for place, label in enumerate(self._labels):
            values[_is_hidden(label, time_s), place] = MISSING_MARKER
        return values.astype(">f4").view(ITEM_DTYPES[ComponentType.MARKERS])[..., 0]

    def _tools(self, samples: SampleNumbers) -> Items:
        time_s = samples / RATE_HZ
        values = np.zeros((len(samples), len(_TOOLS), 8), np.float32)
        for place, (position, angle) in enumerate(self._body.tools(time_s).values()):
            values[:, place, 0], values[:, place, 1] = np.cos(angle / 2), np.sin(angle / 2)
            values[:, place, 4:7] = position
            values[:, place, 7] = 0.3
        for place, labels in enumerate(_TOOLS.values()):
            visible = sum(~_is_hidden(label, time_s) for label in labels)
            values[visible < 3, place] = MISSING
        return values.astype(">f4").view(ITEM_DTYPES[ComponentType.TOOLS])[..., 0]

    def _muscles(self, samples: SampleNumbers) -> Items:
        time_s = samples / ANALOG_RATE_HZ
        values = np.empty((len(samples), len(_MUSCLES)))
        for place, (_, side, active) in enumerate(_MUSCLES):
            phase = ((time_s - FIRST_STRIKE_S[side]) / STRIDE_S) % 1.0
            distance = np.abs((phase - active + 0.5) % 1.0 - 0.5)
            values[:, place] = 0.02 + 0.6 * np.exp(-((distance / 0.1) ** 2))
        voltage_mv: Items = values * self._muscle_noise(samples)
        return voltage_mv.astype(ITEM_DTYPES[ComponentType.ANALOG])

    def _forces(self, samples: SampleNumbers) -> Items:
        """Return the loads: those of ForcePlates during one step on each plate, below the foot."""
        forces = self._plates.forces(samples)
        time_s = samples / ANALOG_RATE_HZ
        for plate, (strike_s, side) in enumerate(zip(PLATE_STRIKES_S, "RL", strict=True)):
            load = forces[:, plate]
            offset_m = 0.06 * SIDES[side]
            load["my"] -= offset_m * load["fz"]
            load["mz"] += offset_m * load["fy"]
            outside = (time_s < strike_s) | (time_s >= strike_s + STANCE * STRIDE_S)
            for name in load.dtype.names or ():
                load[name][outside] = 0
        return forces


def _is_hidden(label: str, time_s: Floats) -> npt.NDArray[np.bool_]:
    hidden = np.zeros(len(time_s), np.bool_)
    for start_s, stop_s in HIDDEN_S.get(label, []):
        hidden |= (time_s >= start_s) & (time_s < stop_s)
    return hidden


def _plate_number(strike_s: float) -> int:
    """Return the number of the plate that the foot strikes, 0 for the ground."""
    return next(
        (n for n, plate_s in enumerate(PLATE_STRIKES_S, start=1) if abs(plate_s - strike_s) < 0.01), 0
    )


_TOOLS: Final = {
    "Head": ("LFHD", "RFHD", "LBHD", "RBHD"),
    "Left foot": ("LANK", "LHEE", "LTOE"),
    "Right foot": ("RANK", "RHEE", "RTOE"),
}

_MUSCLES: Final = (  # name, side, and when in the stride it is most active
    ("EMG left calf", "L", 0.45),
    ("EMG right calf", "R", 0.45),
    ("EMG left thigh", "L", 0.05),
    ("EMG right thigh", "R", 0.05),
)

_EVENTS: Final = ParametersEvents(
    (
        EventDefinition(
            id=f"0x{FOOT_STRIKE:x}",
            label="Foot strike",
            description="A foot touches the ground",
            parameters=(
                EventParameter(
                    "1",
                    "int",
                    "Foot",
                    (ExpectedValue("1", "1", "LEFT", ""), ExpectedValue("2", "2", "RIGHT", "")),
                ),
                EventParameter("2", "int", "Number of the force plate, 0 for the ground"),
            ),
        ),
    )
)
