"""The channels that can be plotted, and their samples."""

from gateway.rtc3d.components import ComponentType
from gateway.view.channels import MAX_CHOICES, Channel, choices, component_of, samples
from tests.takes import START_UTIME
from tests.unit.view.live_lab import Lab

ANALOG = """<Analog><Channels>2</Channels><Channel><Label>EMG</Label><Unit>V</Unit></Channel>
<Channel><Label>Sync</Label></Channel></Analog>"""


def values(lab: Lab, channel: Channel) -> list[tuple[list[int], list[float]]]:
    source = lab.source
    component = component_of(channel, {"lab": source})
    assert component is not None
    return [(utimes.tolist(), found.tolist()) for utimes, found in samples(channel, component)]


def test_channels_have_names_and_units() -> None:
    lab = Lab()
    lab.send(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6)])
    lab.send(ComponentType.ANALOG, [1.0, 2.0])
    lab.send_parameters(ANALOG)
    found = choices([lab.source])
    assert [*found][:3] == ["lab analog 1: EMG (V)", "lab analog 2: Sync (mV)", "lab force 1: plate 1 Fx"]
    assert [*found.values()][2] == Channel("lab", "force", 0, "fx")
    assert len(found) == 2 + 6


def test_choices_are_bounded() -> None:
    lab = Lab()
    lab.send(ComponentType.ANALOG, [0.0] * 10_000)
    found = choices([lab.source])
    assert len(found) == MAX_CHOICES
    assert max(map(len, found)) < 100


def test_samples_of_an_analog_channel() -> None:
    lab = Lab()
    for number in range(3):
        lab.send(ComponentType.ANALOG, [number, 10 * number], utime=START_UTIME + 2000 + number)
    channel = Channel("lab", "analog", 1, "")
    assert values(lab, channel) == [([START_UTIME + number for number in range(3)], [0, 10, 20])]


def test_samples_of_a_force_plate() -> None:
    lab = Lab()
    lab.send(ComponentType.FORCE, [(1, 2, 3, 4, 5, 6), (7, 8, 9, 10, 11, 12)], utime=START_UTIME + 2000)
    assert values(lab, Channel("lab", "force", 1, "mx")) == [([START_UTIME], [10])]


def test_samples_while_the_number_of_channels_changes() -> None:
    lab = Lab()
    for number in range(4):
        lab.send(ComponentType.ANALOG, [number] * (1 + number % 3), utime=START_UTIME + 2000 + number)
    channel = Channel("lab", "analog", 1, "")
    assert values(lab, channel) == [([START_UTIME + 1], [1]), ([START_UTIME + 2], [2])]
    assert component_of(channel, {}) is None
