import os
from pathlib import Path

import pytest
import yaml

from gateway.config.files import MAX_FILE_BYTES
from gateway.config.section import Section
from gateway.config.settings import SourceSettings, StreamSettings
from gateway.errors import ConfigError
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from gateway.rtc3d.commands import Frequency
from gateway.rtc3d.components import ComponentType
from tests.configurations import MODEL, load, make_settings

SHIPPED = Path(__file__).parents[3] / "config"

SERVER = """\
sources:
  - name: lab
    host: 192.0.2.20
"""

SECTIONS = ", ".join(MODEL.model_fields)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "lab.yaml"


def lines_of(error: ConfigError, file: Path) -> list[str]:
    """Return the lines of the error's text, the path in each as its last part only."""
    return [line.replace(str(file), file.name) for line in str(error).splitlines()]


def refused(file: Path, content: str | bytes) -> list[str]:
    """Return the lines of the error that a file with ``content`` raises."""
    file.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ConfigError) as caught:
        load(file)
    return lines_of(caught.value, file)


def test_the_issues_example(file: Path) -> None:
    file.write_text(
        """\
sources:
  - name: lab
    host: 192.0.2.20
    port: 3020
    byte_order: big              # or little
    streams:
      - components: [3d, 6d, event]   # of 3d, 6d, analog, force, event; or [all]
        rate: {frequency_hz: 60}
    reconnect: {first_delay_s: 0.2, max_delay_s: 10}
zenoh: {enabled: true, prefix: mocap, config: {}}
lcm: {enabled: true, prefix: MOCAP, url: "udpm://239.255.76.67:7667?ttl=0"}
""",
        encoding="utf-8",
    )
    components = (ComponentType.MARKERS, ComponentType.TOOLS, ComponentType.EVENT)
    assert load(file) == make_settings(
        sources=(
            SourceSettings(
                name="lab",
                host="192.0.2.20",
                streams=(StreamSettings(components=components, rate=Frequency(60.0)),),
            ),
        ),
        lcm=LcmSettings(url="udpm://239.255.76.67:7667?ttl=0"),
    )


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.name)
def test_every_shipped_configuration_loads(path: Path) -> None:
    assert load(path).sources


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.json5")), ids=lambda path: path.name)
def test_every_shipped_zenoh_configuration_can_be_named(path: Path, file: Path) -> None:
    file.write_text(f"{SERVER}zenoh: {{config: {path}}}\n", encoding="utf-8")
    assert load(file).zenoh.config == path


def stream_in_comments(text: str) -> StreamSettings:
    """Return the stream whose keys are explained in comments."""
    keys = text.partition("    # The keys of a stream and their defaults:\n")[2].partition("\n\n")[0]
    values = yaml.safe_load(keys.replace("    # ", "    "))
    return StreamSettings.model_validate(values[0])


def test_gateway_yaml_has_every_key_with_its_default() -> None:
    settings = load(SHIPPED / "gateway.yaml")
    [source] = settings.sources
    stream = stream_in_comments((SHIPPED / "gateway.yaml").read_text(encoding="utf-8"))
    sections: list[Section] = [settings, source, stream, source.reconnect]
    sections += [settings.spool, settings.zenoh, settings.lcm, settings.metrics]
    for section in sections:
        fields = type(section).model_fields
        assert section.model_fields_set == set(fields), (
            f"{type(section).__name__} has keys that are not there"
        )
        for key, field in fields.items():
            if not field.is_required():
                default = field.get_default(call_default_factory=True)
                assert getattr(section, key) == default, f"{type(section).__name__}.{key} is not the default"


def test_demo_yaml_stays_on_this_machine() -> None:
    settings = load(SHIPPED / "demo.yaml")
    assert [(source.name, source.host, source.port) for source in settings.sources] == [
        ("lab", "127.0.0.1", 3020)
    ]
    assert settings.zenoh.config == {
        "mode": "peer",
        "scouting": {"multicast": {"enabled": False}},
        "listen": {"endpoints": ["tcp/127.0.0.1:7447"]},
    }
    assert settings.lcm == LcmSettings()


MISTAKES: list[tuple[str, str]] = [
    # One line of YAML after SERVER, and the error's one line.
    ("    port: abc", "lab.yaml:4:11: sources[0].port: found 'abc'; expected a whole number from 1 to 65535"),
    (
        "    prot: 3030",
        "lab.yaml:4:5: sources[0].prot: unknown key (did you mean 'port'?); known keys: "
        + ", ".join(SourceSettings.model_fields),
    ),
    ("sorces: 1", f"lab.yaml:4:1: sorces: unknown key (did you mean 'sources'?); known keys: {SECTIONS}"),
    ("on: 1", f"lab.yaml:4:1: on: unknown key; known keys: {SECTIONS}"),
    ("a b: 1", f"lab.yaml:4:1: 'a b': unknown key; known keys: {SECTIONS}"),
    (
        "    byte_order: bigendian",
        "lab.yaml:4:17: sources[0].byte_order: found 'bigendian'; expected big or little",
    ),
    (
        "    streams: [{rate: {frequency_hz: fast}}]",
        "lab.yaml:4:37: sources[0].streams[0].rate.frequency_hz: found 'fast'; expected a number of "
        "frames per second above 0, up to 1000000",
    ),
    (
        "    streams: [{components: [6d, 3D]}]",
        "lab.yaml:4:33: sources[0].streams[0].components[1]: found '3D' (did you mean '3d'?); "
        "expected 3d, 6d, analog, force or event",
    ),
    (
        "    reconnect: {first_delay_s: 20}",
        "lab.yaml:4:16: sources[0].reconnect.max_delay_s: found 10; expected first_delay_s (20) or more",
    ),
    (
        "zenoh:",
        "lab.yaml:4:7: zenoh: found nothing; expected a mapping with any of the keys enabled, prefix, "
        "config, express, max_rate_hz, json_max_rate_hz, tool_poses, "
        "max_queries_per_s, max_queries_per_key_per_s, max_reply_bytes_per_s",
    ),
    ("lcm: {enabled: 1}", "lab.yaml:4:16: lcm.enabled: found 1; expected true or false"),
    ("  - host: lab-2", "lab.yaml:4:5: sources[1].name: missing; this key is required"),
    (
        "  - {name: LAB, host: lab-2}",
        "lab.yaml:4:12: sources[1].name: found 'LAB', which has the same LCM channels as 'lab' (sources[0]); "
        "expected a name that differs in letters or digits, ignoring case",
    ),
    ("    name: lab-2", "lab.yaml:4:5: sources[0].name: the same key as in line 2"),
    ("? [a]\n: 1", "lab.yaml:4:3: found a list or mapping as a key"),
    ("<<: {lcm: {}}", "lab.yaml:4:1: '<<': merge keys are not supported; use an alias as the value of a key"),
    ("lcm: !url memq", "lab.yaml:4:6: lcm: found the tag '!url'; expected a value without a tag"),
    (
        "lcm: !!set {a}",
        "lab.yaml:4:6: lcm: found the tag 'tag:yaml.org,2002:set'; expected a value without a tag",
    ),
    ("lcm: !!int a", "lab.yaml:4:6: lcm: found 'a'; expected a number of at most 40 characters"),
    ("lcm: !!bool a", "lab.yaml:4:6: lcm: found 'a'; expected a number of at most 40 characters"),
    ('lcm: !!int ""', "lab.yaml:4:6: lcm: found ''; expected a number of at most 40 characters"),
    ("lcm: 0x_", "lab.yaml:4:6: lcm: found '0x_'; expected a number of at most 40 characters"),
    (
        f"lcm: {'9' * 41}",
        f"lab.yaml:4:6: lcm: found '{'9' * 41}'; expected a number of at most 40 characters",
    ),
    (r'lcm: "\ud800"', r"lab.yaml:4:6: lcm: found '\ud800'; expected text that UTF-8 can encode"),
    (r'lcm: "\Uffffffff"', "lab.yaml:4:9: not YAML: a number here is out of range"),
    ("lcm: *other", "lab.yaml:4:6: not YAML: found undefined alias 'other'"),
    (
        "lcm: &it [*it]",
        "lab.yaml:4:6: more than 5000 values or 32 levels, counting those that aliases repeat",
    ),
    ("lcm: " + "[" * 2000, "lab.yaml:4:36: not YAML: found more than 32 levels"),
    (
        "lcm: [1",
        "lab.yaml:5:1: not YAML: while parsing a flow sequence from line 4: expected ',' or ']', but got "
        "'<stream end>'; check indentation, colons, quotes and brackets here",
    ),
    (
        "\tlcm: {}",
        r"lab.yaml:4:1: not YAML: found character '\t' that cannot start any token; "
        "check indentation, colons, quotes and brackets here",
    ),
    (
        "---\n{}",
        "lab.yaml:4:1: not YAML: expected a single document in the stream from line 1: "
        "but found another document",
    ),
    ("lcm: \x07", "lab.yaml:4:6: found the character U+0007, which YAML does not allow"),
]


@pytest.mark.parametrize(("line", "error"), MISTAKES, ids=[line[:30] for line, _ in MISTAKES])
def test_a_mistake_is_told_with_its_place(file: Path, line: str, error: str) -> None:
    assert refused(file, f"{SERVER}{line}\n") == [error]


def test_all_mistakes_are_told_in_the_files_order(file: Path) -> None:
    text = """\
lcm: {enable: true}
zenoh: {prefix: /mocap}
sources:
  - host: two words
    port: 70000
"""
    assert refused(file, text) == [
        "lab.yaml:1:7: lcm.enable: unknown key (did you mean 'enabled'?); "
        "known keys: enabled, prefix, url, queries, queries_url, max_rate_hz, tool_poses, "
        "max_queries_per_s, max_queries_per_source_per_s, max_reply_bytes_per_s",
        "lab.yaml:2:17: zenoh.prefix: found '/mocap'; expected a Zenoh key of at most 128 characters, "
        "such as mocap or site/mocap, without spaces, * $ # ?, and without a leading, trailing or double /",
        "lab.yaml:4:5: sources[0].name: missing; this key is required",
        "lab.yaml:4:11: sources[0].host: found 'two words'; expected a host name or an IP address; "
        "the port has its own key",
        "lab.yaml:5:11: sources[0].port: found 70000; expected a whole number from 1 to 65535",
    ]


def test_aliases_repeat_values_and_mistakes_are_told_where_the_value_stands(file: Path) -> None:
    """Sources of one lab often share their settings; each that has the mistake is named."""
    text = """\
sources:
  - {name: a, host: lab-a, reconnect: &patient {max_delay_s: DELAY}}
  - {name: b, host: lab-b, reconnect: *patient}
"""
    file.write_text(text.replace("DELAY", "60"), encoding="utf-8")
    assert [source.reconnect.max_delay_s for source in load(file).sources] == [60.0, 60.0]
    accepted = "found 0; expected a number of seconds from 0.001 to 86400"
    assert refused(file, text.replace("DELAY", "0")) == [
        f"lab.yaml:2:62: sources[{number}].reconnect.max_delay_s: {accepted}" for number in (0, 1)
    ]


def test_aliases_that_grow_without_bound_are_refused(file: Path) -> None:
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 20)]
    [line] = refused(file, "\n".join(rows))
    assert line.endswith(": more than 5000 values or 32 levels, counting those that aliases repeat")


def test_a_date_is_a_name_and_a_byte_order_mark_is_no_mistake(file: Path) -> None:
    """YAML would read the date as one, and some editors on Windows write the mark."""
    file.write_bytes(b"\xef\xbb\xbfsources: [{name: 2026-06-01, host: lab}]")
    assert load(file).sources[0].name == "2026-06-01"


@pytest.mark.parametrize(
    ("content", "error"),
    [
        ("", "empty; expected a mapping with at least the key sources"),
        ("# nothing yet\n", "empty; expected a mapping with at least the key sources"),
        ("[1]", f"1:1: found a list; expected a mapping with any of the keys {SECTIONS}"),
        ("text", f"1:1: found 'text'; expected a mapping with any of the keys {SECTIONS}"),
        ("~", f"1:1: found nothing; expected a mapping with any of the keys {SECTIONS}"),
        ("lcm: {}", "1:1: sources: missing; this key is required"),
        (b"# M\xfcnster", "1:4: found the byte 0xFC; expected text in UTF-8"),
        (b"\xef\xbb\xbf# M\xfcnster", "1:4: found the byte 0xFC; expected text in UTF-8"),
        (
            SERVER.encode() + "# Männer, Münster\n".encode() + b"# M\xfcnster",
            "5:4: found the byte 0xFC; expected text in UTF-8",
        ),
    ],
)
def test_a_file_that_is_no_configuration_is_refused(file: Path, content: str | bytes, error: str) -> None:
    """The position is that of the first wrong character, as an editor counts."""
    [line] = refused(file, content)
    assert line.removeprefix("lab.yaml:").strip() == error


def test_a_file_too_large_is_refused(file: Path) -> None:
    padding = "#" * (MAX_FILE_BYTES - len(SERVER))
    file.write_text(SERVER + padding, encoding="utf-8")
    assert load(file)
    assert refused(file, SERVER + padding + "#") == [
        "lab.yaml: cannot be read: it is too large; the limit is 262144 bytes; "
        "name a YAML file such as config/gateway.yaml"
    ]


def test_a_missing_file_and_a_folder_are_refused(file: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert lines_of(caught.value, file) == [
        "lab.yaml: cannot be read: No such file or directory; name a YAML file such as config/gateway.yaml"
    ]
    file.mkdir()
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert lines_of(caught.value, file) == [
        "lab.yaml: cannot be read: it is a folder, not a file; name a YAML file such as config/gateway.yaml"
    ]


@pytest.mark.parametrize(("count", "more"), [(20, []), (21, [1]), (4000, [3980])])
def test_only_the_first_mistakes_are_listed(file: Path, count: int, more: list[int]) -> None:
    """Nobody reads more than twenty, and at a reload each is a line in the log."""
    lines = refused(file, SERVER + "lcm:\n" + "".join(f"  key{number}: 1\n" for number in range(count)))
    assert lines[19].startswith("lab.yaml:24:3: lcm.key19: unknown key")
    assert lines[20:] == [f"and {number} more mistakes; correct these first" for number in more]


@pytest.mark.parametrize(("count", "is_accepted"), [(4992, True), (4993, False)])
def test_a_file_has_at_most_5000_values(file: Path, count: int, is_accepted: bool) -> None:
    """The limit protects from aliases that grow; eight of them are not in the list here."""
    text = f"{SERVER}zenoh: {{config: {{metadata: [{', '.join('x' * count)}]}}}}"
    file.write_text(text, encoding="utf-8")
    if is_accepted:
        assert load(file)
    else:
        [line] = refused(file, text)
        assert "more than 5000 values" in line


@pytest.mark.parametrize("name", ["zenoh.json5", "zenoh.yaml"])
def test_zenohs_file_with_deep_nesting_is_refused(file: Path, name: str) -> None:
    """Zenoh's own parser overflows the stack, which ends the process."""
    (file.parent / name).write_text("{a: " + "[" * 100_000 + "]" * 100_000 + "}")
    [line] = refused(file, f"{SERVER}zenoh: {{config: {name}}}")
    assert line.endswith("line 1, column 68: found more than 64 nested brackets")


def test_zenohs_file_may_have_brackets_in_texts_and_comments(file: Path) -> None:
    brackets = "[" * 1000
    text = (
        f"// {brackets}\n{{mode: 'client', /* {brackets} \n */ metadata: {{a: '{brackets}\\'{brackets}'}}}}"
    )
    (file.parent / "zenoh.json5").write_text(text)
    file.write_text(f"{SERVER}zenoh: {{config: zenoh.json5}}")
    load(file)


def test_zenohs_file_is_looked_for_beside_this_one(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(f"{SERVER}zenoh: {{config: net/zenoh.json5}}\n", encoding="utf-8")
    zenoh_file = file.parent / "net" / "zenoh.json5"
    zenoh_file.parent.mkdir()
    zenoh_file.write_text("{mode: 'client'} // JSON5", encoding="utf-8")
    assert load(file).zenoh == ZenohSettings(config=zenoh_file)

    monkeypatch.chdir(file.parent)
    assert load(Path(file.name)).zenoh.config == zenoh_file

    zenoh_file.write_text("{mode: 'clint'}", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load(file)
    [line] = lines_of(caught.value, file)
    assert line.startswith(f"lab.yaml:4:17: zenoh.config: Zenoh refuses the file {zenoh_file}: ")
    assert "unknown variant `clint`, expected one of `router`, `peer`, `client`" in line

    zenoh_file.unlink()
    with pytest.raises(ConfigError) as caught:
        load(file)
    assert lines_of(caught.value, file) == [
        f"lab.yaml:4:17: zenoh.config: Zenoh refuses the file {zenoh_file}: No such file or directory"
    ]


def test_a_drawing_of_zenoh_is_put_on_one_line(file: Path) -> None:
    """A log has lines; and a pipe would block the gateway for ever."""
    os.mkfifo(file.parent / "pipe")
    [line] = refused(file, f"{SERVER}zenoh: {{config: pipe}}")
    assert line.endswith("/pipe: it is a pipe (FIFO), not a file")
    zenoh_file = file.parent / "zenoh.json5"
    zenoh_file.write_text("{mode: 'peer',,\n}", encoding="utf-8")
    [line] = refused(file, f"{SERVER}zenoh: {{config: zenoh.json5}}\n")
    assert line == (
        f"lab.yaml:4:17: zenoh.config: Zenoh refuses the file {zenoh_file}: "
        "line 1, column 15: expected identifier or string"
    )
