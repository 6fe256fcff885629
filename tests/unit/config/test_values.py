"""Single values of the configuration: what each type accepts, and the error of everything else."""

from typing import Any

import pytest

from gateway.config.section import Section
from gateway.config.settings import MetricsSettings, SourceSettings, SpoolSettings, StreamSettings
from gateway.config.words import describe, spelling_hint
from gateway.outputs.lcm.settings import DEFAULT_LCM_URL, LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from tests.support.configurations import mistakes, source
from tests.support.errors import names

MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG
HERTZ = "expected a number of frames per second above 0, up to 1000000"
WHOLE = "expected a whole number from 1 to 1000000"
FORMS = "expected all, {frequency_hz: 60} or {divisor: 4}"
COMPONENTS = "3d, 6d, analog, force or event"


def of_source(**values: Any) -> list[tuple[str, str]]:
    return mistakes(SourceSettings, source(**values))


SECONDS = [0, 0.0009, -1, True, "2", float("nan"), float("inf"), 10**400, 86401, None]
BYTES = [1023, 2**32, 1e6, True, "16 MiB"]
PORTS = ["abc", "3020", 0, -1, 65536, True, 3020.0, None, [], {"a": 1}]
INTERVALS = [0.05, 0.0999, -1, 86401, True, float("nan")]


@pytest.mark.parametrize(
    ("keys", "accepted", "refused", "expected"),
    [
        ("port", [1, 65535], PORTS, [1, 65535]),
        (
            "connect_timeout_s reply_timeout_s stall_timeout_s",
            [0.001, 5, 86400],
            SECONDS,
            [0.001, 86400],
        ),
        (
            "max_packet_bytes max_c3d_bytes",
            [1024, 2**32 - 1],
            BYTES,
            [1024, 4294967295],
        ),
        (
            "parameters_interval_s",
            [0, 0.1, 86400],
            INTERVALS,
            [0, 0.1, 86400],
        ),
    ],
)
def test_numbers_within_their_limits(
    keys: str, accepted: list[float], refused: list[object], expected: list[float]
) -> None:
    """The limits protect from typing errors, and a number in quotes or a switch is no number."""
    for key in keys.split():
        for value in accepted:
            assert getattr(SourceSettings.model_validate(source(**{key: value})), key) == value
        for other in refused:
            [(location, text)] = of_source(**{key: other})
            assert location == key
            assert text.startswith(f"found {describe(other)}; expected ")
            assert names(text, *expected)


def test_host_names_and_addresses_are_accepted() -> None:
    """Whatever a name server or the system takes for a host; the last one has 253 characters."""
    hosts = (
        "lab ndi-3.example.org. 192.0.2.20 2001:db8::1 fe80::1%eth0 fe80::1%2 rt_server bücher.example 3d.lab"
    )
    for host in (*hosts.split(), "a" * 63, ".".join(["a" * 63] * 3 + ["a" * 61])):
        assert SourceSettings.model_validate(source(host=host)).host == host


@pytest.mark.parametrize(
    "host",
    [
        *("", "192.0.2.300", "192.0.2", "192.0.2.20:3020", "tcp://lab", "a b", "a..b", "a" * 64, "a." * 127),
        *("lab\n", "lab\0", "lab\x1b[31m", "lab\udc80", ".lab", "lab.."),
        *("ü" * 63, ".".join(["ü" * 50] * 5)),  # too long in IDNA: a label, a name
        # what the resolver takes for numbers
        *("127.1", "2130706433", "0x7f.1", "127.0.0.0x1", "0177.0.0.1", "１２７.０.０.１"),
        *("fe80::1%", "fe80::1%eth 0", "fe80::1%eth0\n", "fe80::1%eth0%1", "192.0.2.20%eth0"),
        "fe80::1%an-interface-with-a-long-name",
    ],
)
def test_invalid_hosts_are_refused(host: str) -> None:
    """A typing error is reported at the start, not by a name server a minute later."""
    [(location, text)] = of_source(host=host)
    assert location == "host"
    assert text.startswith("found ")


def test_names_that_do_not_fit_keys_and_channels_are_refused() -> None:
    """A name is part of Zenoh keys and LCM channels; the hint helps who writes a number."""
    for name in ("", "a b", "a/b", "a.b", "é", "lab\n", "a" * 25):
        assert [location for location, _ in of_source(name=name)] == ["name"]
    assert names(of_source(name=5)[0][1], 5, "quotes", "1 to 24")


def test_rates_are_accepted_in_three_forms() -> None:
    """They are those of StreamFrames (§5.3.5)."""
    values = ["all", {"frequency_hz": 60}, {"frequency_hz": 0.5}, {"divisor": 4}, Frequency(60.0)]
    rates = [AllFrames(), Frequency(60.0), Frequency(0.5), FrequencyDivisor(4), Frequency(60.0)]
    assert [StreamSettings.model_validate({"rate": value}).rate for value in values] == rates


@pytest.mark.parametrize(
    ("value", "location", "text"),
    [
        ("fast", "rate", f"found 'fast'; {FORMS}"),
        (60, "rate", f"found 60; {FORMS}"),
        (None, "rate", f"found nothing; {FORMS}"),
        ({"hz": 60}, "rate", f"found a mapping; {FORMS}"),
        ({"frequency_hz": 0}, "rate.frequency_hz", f"found 0; {HERTZ}"),
        ({"frequency_hz": "60"}, "rate.frequency_hz", f"found '60'; {HERTZ}"),
        ({"frequency_hz": float("inf")}, "rate.frequency_hz", f"found inf; {HERTZ}"),
        ({"divisor": 0}, "rate.divisor", f"found 0; {WHOLE}"),
        ({"divisor": 1.5}, "rate.divisor", f"found 1.5; {WHOLE}"),
        ({"divisor": True}, "rate.divisor", f"found true; {WHOLE}"),
        ({"divisor": 2, "divisors": 2}, "rate.divisors", "unknown key"),
        ({"divisor": 2, "frequency_hz": 2}, "rate", "found frequency_hz and divisor"),
    ],
)
def test_other_rates_are_refused(value: object, location: str, text: str) -> None:
    """The error is at the innermost key that is wrong."""
    [(found, message)] = mistakes(StreamSettings, {"rate": value})
    assert found == location
    assert message.startswith(text)


def test_components_are_kept_in_wire_order() -> None:
    """So that equal choices are equal, however they are written."""
    values = [["all"], ["3d"], ["event", "force", "analog", "6d", "3d"], ["analog", "3d"], (TOOLS, MARKERS)]
    found = [StreamSettings.model_validate({"components": value}).components for value in values]
    assert found == [WIRE_ORDER, (MARKERS,), WIRE_ORDER, (MARKERS, ANALOG), (MARKERS, TOOLS)]


@pytest.mark.parametrize(
    ("value", "location", "found"),
    [
        ([], "components", "list"),
        ("all", "components", "'all'"),
        (None, "components", "nothing"),
        (["all", "3d"], "components.0", "'all'"),
        (["3d", "6d", "3d"], "components.2", "'3d'"),
        (["3d", "Events"], "components.1", "'Events'"),
        (["3d", "Events"], "components.1", "'event'"),
        (["markers"], "components.0", "'markers'"),
        ([1], "components.0", 1),
    ],
)
def test_other_components_are_refused(value: object, location: str, found: object) -> None:
    """The error is at the item that is wrong."""
    [(place, text)] = mistakes(StreamSettings, {"components": value})
    assert place == location
    assert names(text, found, "expected")


def test_the_error_of_an_unknown_component_says_which_ones_there_are() -> None:
    [(_, text)] = mistakes(StreamSettings, {"components": ["markers"]})
    assert names(text, *(component.key for component in WIRE_ORDER))


def test_max_rates_are_those_of_components() -> None:
    """A limit for a component that does not exist would do nothing, unnoticed."""
    rates = LcmSettings.model_validate({"max_rate_hz": {"3d": 60, "analog": 0.5, TOOLS: 1.0}}).max_rate_hz
    assert rates == {MARKERS: 60.0, ANALOG: 0.5, TOOLS: 1.0}
    for value, error in (
        ({"3d": 0}, ("max_rate_hz.3d", f"found 0; {HERTZ}")),
        ({"3D": 60}, ("max_rate_hz", f"found '3D'{spelling_hint('3D', ['3d'])}; expected {COMPONENTS}")),
        ([60], ("max_rate_hz", "found a list; expected a mapping such as {3d: 60}, or {}")),
    ):
        assert mistakes(LcmSettings, {"max_rate_hz": value}) == [error]


KEYS = ["mocap", "a/b", "hall-2/mocap.x", "überlab", "a" * 128]
NO_KEYS = ["", "/a", "a/", "a//b", "*", "a/**", "a$*", "a#", "a?b", "a b", "a\tb", "a\x07b", "a" * 129]
URLS = [DEFAULT_LCM_URL, "udpm://?ttl=1", "mpudpm://", "memq://", "tcpq://lab:7700", "file:///tmp/x@y"]
NO_URLS = ["", "udpm://a b", "udpm://\n", "udpm", "udpm:", "239.255.76.67:7667", "UDPM://", "zmq://x"]
NO_URLS += ["tcpq://me@lab", "tcpq://a..b:7700", "tcpq://127.1:7700"]


@pytest.mark.parametrize(
    ("section", "key", "accepted", "refused", "expected"),
    [
        (ZenohSettings, "prefix", KEYS, NO_KEYS, [128]),
        (LcmSettings, "url", URLS, NO_URLS, ["udpm://", "mpudpm://", "memq://", "tcpq://", "file://"]),
        (LcmSettings, "prefix", ["MOCAP", "a_1", "A" * 16], ["", "A-B", "Ä", "A" * 17], []),
        (SpoolSettings, "max_files", [1, 100_000], [0, 100_001, 1.0], [1, 100_000]),
        (SpoolSettings, "directory", ["/var/lib"], ["", "var", "/a\nb"], ["absolute"]),
        (MetricsSettings, "port", [1, 65535], [0, 65536, "9464"], [1, 65535]),
        (ZenohSettings, "express", [True, False], [1, 0, "yes", None], ["true", "false"]),
    ],
)
def test_values_of_other_sections(
    section: type[Section], key: str, accepted: list[object], refused: list[object], expected: list[object]
) -> None:
    """What the library or the system behind the key cannot use is refused at the start."""
    for value in accepted:
        assert getattr(section.model_validate({key: value}), key) == value
    for value in refused:
        [(location, text)] = mistakes(section, {key: value})
        assert location == key
        assert text.startswith(f"found {describe(value)}; expected ")
        assert names(text, *expected)


def test_keys_of_zenoh_itself_are_accepted() -> None:
    config = {"mode": "client", "connect": {"endpoints": ["tcp/127.0.0.1:7447"]}}
    assert ZenohSettings.model_validate({"config": config}).config == config


ZENOH_REFUSES = "Zenoh refuses these keys: "


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (
            {"mode": "per"},
            f"{ZENOH_REFUSES}unknown variant `per`",
        ),
        ({"connect": {"endpoints": ["nowhere"]}}, f"{ZENOH_REFUSES}Endpoints must be of the form"),
        ({"mode": float("nan")}, ZENOH_REFUSES),
        ({"mode": b"peer"}, f"{ZENOH_REFUSES}Object of type bytes"),
        ([], "found an empty list; expected "),
        ("a\nb", "found 'a\\nb'; expected "),
        ("", "found ''; expected "),
        (True, "found true; expected "),
    ],
)
def test_configurations_that_zenoh_refuses_are_refused(config: object, text: str) -> None:
    [(location, found)] = mistakes(ZenohSettings, {"config": config})
    assert location == "config"
    assert found.startswith(text)
    assert ".rs" not in found
