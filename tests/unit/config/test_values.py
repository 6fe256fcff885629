import pytest

from gateway.config.settings import SourceSettings, StreamSettings
from gateway.config.words import describe
from gateway.outputs.lcm.settings import DEFAULT_LCM_URL, LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor, Rate
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from tests.settings import mistakes, source

MARKERS, TOOLS, ANALOG = ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.ANALOG


@pytest.mark.parametrize(
    ("port", "found"),
    [
        ("abc", "'abc'"),
        ("3020", "'3020'"),
        (0, "0"),
        (-1, "-1"),
        (65536, "65536"),
        (True, "true"),
        (3020.0, "3020.0"),
        (None, "nothing"),
        ([], "an empty list"),
        ({"a": 1}, "a mapping"),
    ],
)
def test_invalid_ports_are_refused(port: object, found: str) -> None:
    assert mistakes(SourceSettings, source(port=port)) == [
        ("port", f"found {found}; expected a whole number from 1 to 65535")
    ]


@pytest.mark.parametrize("value", [0, -1, True, "2", float("nan"), float("inf"), 10**400, 86401, None])
@pytest.mark.parametrize("key", ["connect_timeout_s", "reply_timeout_s", "stall_timeout_s"])
def test_invalid_times_are_refused(key: str, value: object) -> None:
    [(location, text)] = mistakes(SourceSettings, source(**{key: value}))
    assert location == key
    assert text.endswith("; expected a number of seconds from 0.001 to 86400")


def test_an_integer_number_of_seconds_is_accepted() -> None:
    assert SourceSettings.model_validate(source(stall_timeout_s=5)).stall_timeout_s == 5.0


@pytest.mark.parametrize("value", [1023, 2**32, 1e6, True, "16 MiB"])
def test_limits_outside_the_size_field_are_refused(value: object) -> None:
    [(_, text)] = mistakes(SourceSettings, source(max_c3d_bytes=value))
    assert text.endswith("; expected a whole number of bytes from 1024 to 4294967295")


@pytest.mark.parametrize("value", [1, 0, "yes", None])
def test_a_switch_must_be_true_or_false(value: object) -> None:
    assert mistakes(ZenohSettings, {"express": value}) == [
        ("express", f"found {describe(value)}; expected true or false")
    ]


@pytest.mark.parametrize(
    "host",
    [
        "lab",
        "ndi-3.example.org.",
        "192.0.2.20",
        "2001:db8::1",
        "fe80::1%eth0",
        "fe80::1%2",
        "rt_server",
        "bücher.example",
        "3d.lab",
        "a" * 63,
        ".".join(["a" * 63] * 3 + ["a" * 61]),  # 253 characters
    ],
)
def test_host_names_and_addresses_are_accepted(host: str) -> None:
    assert SourceSettings.model_validate(source(host=host)).host == host


@pytest.mark.parametrize(
    "host",
    [
        "",
        "192.0.2.300",
        "192.0.2",
        "192.0.2.20:3020",
        "tcp://lab",
        "a b",
        "a..b",
        "a" * 64,
        "lab\n",
        "lab\0",
        "lab\x1b[31m",
        "lab\udc80",
        "a." * 127,
        "ü" * 63,  # a label of more than 63 characters in IDNA
        ".".join(["ü" * 50] * 5),  # a name of more than 253 in IDNA
        ".lab",
        "lab..",
        "127.1",  # what the resolver takes for numbers
        "2130706433",
        "0x7f.1",
        "127.0.0.0x1",
        "0177.0.0.1",
        "１２７.０.０.１",
        "fe80::1%",
        "fe80::1%eth 0",
        "fe80::1%eth0\n",
        "fe80::1%eth0%1",
        "fe80::1%an-interface-with-a-long-name",
        "192.0.2.20%eth0",
    ],
)
def test_invalid_hosts_are_refused(host: str) -> None:
    [(location, text)] = mistakes(SourceSettings, source(host=host))
    assert location == "host"
    assert text.endswith("; expected a host name or an IP address; the port has its own key")


def test_the_error_for_a_number_as_name_suggests_quotes() -> None:
    assert mistakes(SourceSettings, source(name=5)) == [
        (
            "name",
            "found 5 (use quotes to make it text); expected 1 to 24 of the letters A to Z and a to z, "
            "digits, '_' and '-'",
        )
    ]


@pytest.mark.parametrize("name", ["", "a b", "a/b", "a.b", "é", "lab\n", "a" * 25])
def test_names_that_do_not_fit_keys_and_channels_are_refused(name: str) -> None:
    assert [location for location, _ in mistakes(SourceSettings, source(name=name))] == ["name"]


@pytest.mark.parametrize(
    ("value", "rate"),
    [
        ("all", AllFrames()),
        ({"frequency_hz": 60}, Frequency(60.0)),
        ({"frequency_hz": 0.5}, Frequency(0.5)),
        ({"divisor": 4}, FrequencyDivisor(4)),
        (Frequency(60.0), Frequency(60.0)),
    ],
)
def test_rates_are_accepted_in_three_forms(value: object, rate: Rate) -> None:
    assert StreamSettings.model_validate({"rate": value}).rate == rate


@pytest.mark.parametrize(
    ("value", "location", "text"),
    [
        ("fast", "rate", "found 'fast'; expected all, {frequency_hz: 60} or {divisor: 4}"),
        (60, "rate", "found 60; expected all, {frequency_hz: 60} or {divisor: 4}"),
        (None, "rate", "found nothing; expected all, {frequency_hz: 60} or {divisor: 4}"),
        ({"hz": 60}, "rate", "found a mapping; expected all, {frequency_hz: 60} or {divisor: 4}"),
        (
            {"frequency_hz": 0},
            "rate.frequency_hz",
            "found 0; expected a number of frames per second above 0, up to 1000000",
        ),
        (
            {"frequency_hz": "60"},
            "rate.frequency_hz",
            "found '60'; expected a number of frames per second above 0, up to 1000000",
        ),
        (
            {"frequency_hz": float("inf")},
            "rate.frequency_hz",
            "found inf; expected a number of frames per second above 0, up to 1000000",
        ),
        ({"divisor": 0}, "rate.divisor", "found 0; expected a whole number from 1 to 1000000"),
        ({"divisor": 1.5}, "rate.divisor", "found 1.5; expected a whole number from 1 to 1000000"),
        ({"divisor": True}, "rate.divisor", "found true; expected a whole number from 1 to 1000000"),
        (
            {"divisor": 2, "divisors": 2},
            "rate.divisors",
            "unknown key (did you mean 'divisor'?); known keys: divisor",
        ),
        (
            {"divisor": 2, "frequency_hz": 2},
            "rate",
            "found frequency_hz and divisor together; expected one of them",
        ),
    ],
)
def test_other_rates_are_refused(value: object, location: str, text: str) -> None:
    assert mistakes(StreamSettings, {"rate": value}) == [(location, text)]


@pytest.mark.parametrize(
    ("value", "components"),
    [
        (["all"], WIRE_ORDER),
        (["3d"], (MARKERS,)),
        (["event", "force", "analog", "6d", "3d"], WIRE_ORDER),
        (["analog", "3d"], (MARKERS, ANALOG)),
        ((TOOLS, MARKERS), (MARKERS, TOOLS)),
    ],
)
def test_components_are_kept_in_wire_order(value: object, components: tuple[ComponentType, ...]) -> None:
    assert StreamSettings.model_validate({"components": value}).components == components


@pytest.mark.parametrize(
    ("value", "location", "text"),
    [
        (
            [],
            "components",
            "found an empty list; expected a list of 3d, 6d, analog, force or event, or [all]",
        ),
        ("all", "components", "found 'all'; expected a list of 3d, 6d, analog, force or event, or [all]"),
        (None, "components", "found nothing; expected a list of 3d, 6d, analog, force or event, or [all]"),
        (["all", "3d"], "components.0", "found 'all' beside other components; expected [all] alone"),
        (["3d", "6d", "3d"], "components.2", "found '3d' twice; expected each component once"),
        (
            ["3d", "Events"],
            "components.1",
            "found 'Events' (did you mean 'event'?); expected 3d, 6d, analog, force or event",
        ),
        (["markers"], "components.0", "found 'markers'; expected 3d, 6d, analog, force or event"),
        ([1], "components.0", "found 1; expected 3d, 6d, analog, force or event"),
    ],
)
def test_other_components_are_refused(value: object, location: str, text: str) -> None:
    assert mistakes(StreamSettings, {"components": value}) == [(location, text)]


@pytest.mark.parametrize("prefix", ["mocap", "a/b", "hall-2/mocap.x", "überlab"])
def test_a_key_prefix_can_have_several_chunks(prefix: str) -> None:
    assert ZenohSettings.model_validate({"prefix": prefix}).prefix == prefix


@pytest.mark.parametrize(
    "prefix", ["", "/a", "a/", "a//b", "*", "a/**", "a$*", "a#", "a?b", "a b", "a\tb", "a\x07b", "a" * 129]
)
def test_invalid_key_prefixes_are_refused(prefix: str) -> None:
    [(location, text)] = mistakes(ZenohSettings, {"prefix": prefix})
    assert location == "prefix"
    assert text.startswith(f"found {describe(prefix)}; expected a Zenoh key")


def test_keys_of_zenoh_itself_are_accepted() -> None:
    config = {"mode": "client", "connect": {"endpoints": ["tcp/127.0.0.1:7447"]}}
    assert ZenohSettings.model_validate({"config": config}).config == config


@pytest.mark.parametrize(
    ("config", "text"),
    [
        (
            {"mode": "per"},
            "Zenoh refuses these keys: unknown variant `per`, expected one of `router`, `peer`, `client`",
        ),
        ({"connect": {"endpoints": ["nowhere"]}}, "Zenoh refuses these keys: Endpoints must be of the form"),
        ({"mode": float("nan")}, "Zenoh refuses these keys: Out of range float"),
        ({"mode": b"peer"}, "Zenoh refuses these keys: Object of type bytes"),
        ([], "found an empty list; expected a JSON5 file's path or a mapping with Zenoh's own keys"),
        ("a\nb", "found 'a\\nb'; expected a JSON5 file's path or a mapping with Zenoh's own keys"),
        ("", "found ''; expected a JSON5 file's path or a mapping with Zenoh's own keys"),
        (True, "found true; expected a JSON5 file's path or a mapping with Zenoh's own keys"),
    ],
)
def test_configurations_that_zenoh_refuses_are_refused(config: object, text: str) -> None:
    [(location, found)] = mistakes(ZenohSettings, {"config": config})
    assert location == "config"
    assert found.startswith(text)
    assert ".rs" not in found


@pytest.mark.parametrize(
    "url",
    [
        DEFAULT_LCM_URL,
        "udpm://?ttl=1",
        "mpudpm://",
        "memq://",
        "tcpq://lab:7700",
        "file:///tmp/x@y?mode=w",
    ],
)
def test_urls_of_all_lcm_providers_are_accepted(url: str) -> None:
    assert LcmSettings(url=url).effective_url == url


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udpm",
        "udpm:",
        "239.255.76.67:7667",
        "UDPM://",
        "zmq://x",
        "udpm://a b",
        "udpm://\n",
        "tcpq://me@lab",
        "tcpq://a..b:7700",
        "tcpq://127.1:7700",
    ],
)
def test_other_lcm_urls_are_refused(url: str) -> None:
    assert mistakes(LcmSettings, {"url": url}) == [
        (
            "url",
            f"found {describe(url)}; expected a URL that begins with udpm://, mpudpm://, memq://, tcpq:// "
            "or file://, without a user name",
        )
    ]


@pytest.mark.parametrize("prefix", ["", "A-B", "Ä", "A" * 17])
def test_invalid_channel_prefixes_are_refused(prefix: str) -> None:
    assert [location for location, _ in mistakes(LcmSettings, {"prefix": prefix})] == ["prefix"]
