from pathlib import Path

import pytest
import yaml
import zenoh
from hypothesis import given
from hypothesis import strategies as st
from pydantic import TypeAdapter, ValidationError

from gateway.config.settings import ReconnectSettings, Settings, SourceSettings, StreamSettings
from gateway.errors import ConfigError
from gateway.messages import topics
from gateway.outputs.lcm.settings import LCM_SCHEMES, LcmSettings
from gateway.outputs.zenoh.settings import KeyPrefix, ZenohSettings
from gateway.rtc3d.commands import AllFrames, Frequency, FrequencyDivisor
from gateway.rtc3d.components import WIRE_ORDER, ComponentType
from tests.support.configurations import load, make_settings
from tests.support.strategies import damaged

ROOT = Path(__file__).parents[2]
# Without the comments, so that damage hits keys and values.
GATEWAY_YAML = yaml.safe_dump(yaml.safe_load((ROOT / "config" / "gateway.yaml").read_text("utf-8"))).encode()

# The elements of YAML files, and texts that are difficult for parsers.
PIECES = [
    *["sources", "name", "host", "streams", "components", "rate", "zenoh", "config", "lcm", "url", "enabled"],
    *[
        "lab",
        "all",
        "3d",
        "60",
        "true",
        "no",
        "~",
        ".nan",
        "1e400",
        "0x_",
        "0b_",
        "1:30",
        "2026-99-99",
        "<<",
        "=",
    ],
    *(": ", "- ", "? ", ", ", "[", "]", "{", "}", "\n", "\n  ", "\t", "# ", "---\n", "...\n", "%YAML 1.1\n"),
    *("&a ", "*a", "!!int ", "!!bool ", "!!null ", "!x ", "!<", "|\n", ">-\n"),
    *("'", '"', "\\", "\\ud800", "\\U"),
]

SECONDS = st.floats(0.001, 86400)
RATES = st.one_of(
    st.just(AllFrames()),
    st.builds(Frequency, st.floats(1.0, 1e6)),
    st.builds(FrequencyDivisor, st.integers(1, 10**6)),
)


@st.composite
def streams(draw: st.DrawFn) -> tuple[StreamSettings, ...]:
    """Return streams that share no component."""
    owners = draw(st.lists(st.integers(0, 4), min_size=5, max_size=5))
    parts = [
        tuple(component for component, owner in zip(WIRE_ORDER, owners, strict=True) if owner == stream)
        for stream in range(4)
    ]
    named: list[tuple[ComponentType, ...]] = [part for part in parts if part] or [WIRE_ORDER]
    return tuple(StreamSettings(components=part, rate=draw(RATES)) for part in named)


@st.composite
def reconnects(draw: st.DrawFn) -> ReconnectSettings:
    first, longest = sorted([draw(SECONDS), draw(SECONDS)])
    return ReconnectSettings(first_delay_s=first, max_delay_s=longest)


SOURCES = st.builds(
    SourceSettings,
    name=st.from_regex(r"\A[A-Za-z0-9_-]{1,24}\Z"),
    host=st.sampled_from(["lab", "192.0.2.20", "::1", "ndi.example.org", "5a", "on", "2026-06-01"]),
    port=st.integers(1, 65535),
    byte_order=st.sampled_from(["big", "little"]),
    streams=streams(),
    reconnect=reconnects(),
    connect_timeout_s=SECONDS,
    reply_timeout_s=SECONDS,
    stall_timeout_s=st.floats(1.5, 86400),
    max_packet_bytes=st.integers(1024, 2**32 - 1),
    max_c3d_bytes=st.integers(1024, 2**32 - 1),
)
SETTINGS = st.builds(
    make_settings,
    sources=st.lists(
        SOURCES, min_size=1, max_size=2, unique_by=lambda source: topics.lcm_channel("", source.name)
    ).map(tuple),
    zenoh=st.builds(
        ZenohSettings,
        prefix=st.from_regex(r"\A[a-z.~]{1,8}(/[a-z0-9]{1,8}){0,2}\Z"),
        express=st.booleans(),
        tool_poses=st.booleans(),
    ),
    lcm=st.builds(
        LcmSettings,
        enabled=st.booleans(),
        prefix=st.from_regex(r"\A[A-Za-z0-9_]{1,16}\Z"),
        url=st.none() | st.sampled_from([f"{scheme}://" for scheme in LCM_SCHEMES]),
        tool_poses=st.booleans(),
    ),
)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("config") / "lab.yaml"


@given(settings=SETTINGS)
def test_written_settings_are_read_back(file: Path, settings: Settings) -> None:
    values = settings.model_dump(mode="json")
    file.write_text(yaml.dump(values, Dumper=yaml.CSafeDumper), encoding="utf-8")
    assert load(file) == settings


@given(
    content=st.one_of(
        damaged(st.just(GATEWAY_YAML)),
        st.lists(st.sampled_from(PIECES), max_size=40).map(lambda pieces: "".join(pieces).encode()),
        st.text().map(lambda text: text.encode("utf-8", "surrogatepass")),
        st.binary(),
    )
)
def test_any_file_gives_settings_or_lines_with_its_path(file: Path, content: bytes) -> None:
    file.write_bytes(content)
    try:
        settings = load(file)
    except ConfigError as error:
        lines = str(error).split("\n")
        assert all(line.startswith(f"{file}:") for line in lines)
    else:
        assert settings.sources


@given(
    first=st.from_regex(r"\A[ABab_-]{1,4}\Z"),
    second=st.from_regex(r"\A[ABab_-]{1,4}\Z"),
    has_lcm=st.booleans(),
)
def test_names_are_refused_exactly_if_they_are_the_same_or_share_channels(
    first: str, second: str, has_lcm: bool
) -> None:
    sources = tuple(SourceSettings(name=name, host="lab") for name in (first, second))
    share_channels = topics.lcm_channel("MOCAP", first) == topics.lcm_channel("MOCAP", second)
    problem = (
        "the name of" if first == second else "the same LCM channels" if has_lcm and share_channels else ""
    )
    if problem:
        with pytest.raises(ValidationError, match=problem):
            make_settings(sources=sources, lcm={"enabled": has_lcm})
    else:
        assert make_settings(sources=sources, lcm={"enabled": has_lcm}).sources == sources


@given(st.text(st.sampled_from("ab/*$#? @é\n\x07"), max_size=6) | st.text())
def test_zenoh_takes_every_prefix_that_is_accepted(prefix: str) -> None:
    try:
        TypeAdapter(KeyPrefix).validate_python(prefix)
    except ValidationError:
        return
    key = zenoh.KeyExpr(f"{prefix}/lab/3d")
    assert str(key) == f"{prefix}/lab/3d"
