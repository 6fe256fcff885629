"""Configuration files: what is read from them, and the error of everything else."""

import errno
import os
import re
import socket
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from gateway.config.document import INDENTATION_TEXT
from gateway.config.files import MAX_FILE_BYTES, read_file
from gateway.config.loading import read
from gateway.config.section import Section
from gateway.config.settings import StreamSettings
from gateway.errors import ConfigError
from gateway.outputs.lcm.settings import LcmSettings
from gateway.outputs.zenoh.settings import ZenohSettings
from tests.support.configurations import MODEL, load
from tests.support.errors import names

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


def refused(file: Path, content: str | bytes | None = None) -> list[str]:
    """Return the lines of the error for the file, or for this content, without its path."""
    if content is not None:
        file.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ConfigError) as caught:
        load(file)
    return [line.removeprefix(f"{file}:").lstrip() for line in str(caught.value).splitlines()]


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.yaml")), ids=lambda path: path.name)
def test_every_shipped_configuration_loads(path: Path) -> None:
    assert load(path).sources


@pytest.mark.parametrize("path", sorted(SHIPPED.glob("*.json5")), ids=lambda path: path.name)
def test_every_shipped_zenoh_configuration_can_be_named(path: Path, file: Path) -> None:
    file.write_text(f"{SERVER}zenoh: {{config: {path}}}\n")
    assert load(file).zenoh.config == path


def test_gateway_yaml_has_every_key_with_its_default() -> None:
    settings = load(SHIPPED / "gateway.yaml")
    [source] = settings.sources
    _, _, comments = (
        (SHIPPED / "gateway.yaml").read_text().partition("# The keys of a stream and their defaults:\n")
    )
    keys = comments.partition("\n\n")[0].replace("    # ", "    ")
    stream = StreamSettings.model_validate(yaml.safe_load(keys)[0])
    sections: list[Section] = [settings, source, stream, source.reconnect]
    sections += [settings.spool, settings.history, settings.zenoh, settings.lcm, settings.metrics]
    for section in sections:
        fields = type(section).model_fields
        assert section.model_fields_set == set(fields), f"{type(section).__name__} lacks keys"
        for key, field in fields.items():
            if not field.is_required():
                default = field.get_default(call_default_factory=True)
                assert getattr(section, key) == default, f"{type(section).__name__}.{key} is not the default"


def test_demo_yaml_stays_on_this_machine() -> None:
    settings = load(SHIPPED / "demo.yaml")
    assert [(each.name, each.host, each.port) for each in settings.sources] == [("lab", "127.0.0.1", 3020)]
    listen = {"endpoints": ["tcp/127.0.0.1:7447"]}
    scouting = {"multicast": {"enabled": False}}
    assert settings.zenoh.config == {"mode": "peer", "scouting": scouting, "listen": listen}
    assert settings.lcm == LcmSettings()


MISTAKES = [
    # One line of YAML after SERVER, and how the error's one line begins.
    ("    port: abc", "4:11: sources[0].port: found 'abc'"),
    ("    prot: 3030", "4:5: sources[0].prot: unknown key"),
    ("sorces: 1", "4:1: sorces: unknown key"),
    ("on: 1", "4:1: on: unknown key"),
    ("a b: 1", "4:1: 'a b': unknown key"),
    ("    byte_order: big-endian", "4:17: sources[0].byte_order: found 'big-endian'"),
    ("    streams: [{rate: {frequency_hz: x}}]", "4:37: sources[0].streams[0].rate.frequency_hz: found 'x'"),
    ("    streams: [{components: [6d, 3D]}]", "4:33: sources[0].streams[0].components[1]: found '3D' (did"),
    ("    reconnect: {first_delay_s: 20}", "4:16: sources[0].reconnect.max_delay_s: found 10"),
    ("zenoh:", "4:7: zenoh: found nothing"),
    ("lcm: {enabled: 1}", "4:16: lcm.enabled: found 1"),
    ("  - host: lab-2", "4:5: sources[1].name: missing"),
    ("  - {name: LAB, host: x}", "4:12: sources[1].name: found 'LAB'"),
    ("    name: lab-2", "4:5: sources[0].name: the same key"),
    ("? [a]\n: 1", "4:3: found a list"),
    ("<<: {lcm: {}}", "4:1: '<<': merge keys"),
    ("lcm: !url memq", "4:6: lcm: found the tag '!url'"),
    ("lcm: !!set {a}", "4:6: lcm: found the tag 'tag:yaml.org,2002:set'"),
    ("lcm: !!int a", "4:6: lcm: found 'a'"),
    ("lcm: !!bool a", "4:6: lcm: found 'a'"),
    ('lcm: !!int ""', "4:6: lcm: found ''"),
    ("lcm: 0x_", "4:6: lcm: found '0x_'"),
    (f"lcm: {'9' * 41}", f"4:6: lcm: found '{'9' * 41}'"),
    (r'lcm: "\ud800"', r"4:6: lcm: found '\ud800'"),
    (r'lcm: "\Uffffffff"', "4:9: not YAML: a number here"),
    ("lcm: *other", "4:6: not YAML: found undefined alias"),
    ("lcm: &it [*it]", "4:6: more than 5000 values"),
    ("lcm: " + "[" * 2000, "4:36: not YAML: found more than 32"),
    ("lcm: [1", "5:1: not YAML: while parsing"),
    ("\tlcm: {}", "4:1: found a tab"),
    ("lcm:\n\tenabled: true", "5:1: found a tab"),
    ("lcm: # with a\ttab\n  \tenabled: true", "5:3: found a tab"),
    ("lcm:\n\u00a0\u00a0enabled: true", "5:1: found the character U+00A0"),
    ("\u00a0lcm: {}", "4:1: found the character U+00A0"),
    ("lcm:\n  enabled: true\n \u00a0url: memq://", "6:2: found the character U+00A0"),
    ("lcm: {\u00a0enabled: true}", "4:7: lcm: found the character U+00A0"),
    ("lcm:\u00a0\n  enabled: true", "4:5: found the character U+00A0"),
    ("   lcm: {}", f"4:4: {INDENTATION_TEXT}"),
    ("      port: 3030", f"4:11: {INDENTATION_TEXT}"),
    ("lcm:\n    enabled: true\n   url: memq://", f"6:4: {INDENTATION_TEXT}"),
    ("lcm: enabled: true", f"4:13: {INDENTATION_TEXT}"),
    ("lcm\nmetrics: {}", f"5:1: {INDENTATION_TEXT}"),
    ("\t# a comment\nlcm: {}", "4:1: found a tab"),
    ("---\n{}", "4:1: not YAML: expected a single document"),
    ("lcm: \x07", "4:6: found the character U+0007"),
]


def test_text_before_the_first_key_is_explained_where_the_keys_begin(file: Path) -> None:
    """It is a comment that has lost its #."""
    [found] = refused(file, f"a comment without its sign\n# and one with it\n{SERVER}")
    assert found == f"3:1: {INDENTATION_TEXT}"


def test_every_one_of_several_equal_ports_and_names_is_reported(file: Path) -> None:
    """Whoever corrects one pair must not find the next one at the next start."""
    ports = (
        "metrics: {port: 4000}\nfoxglove: {enabled: true, port: 4000}\nvrpn: {enabled: true, port: 4000}\n"
    )
    assert len(refused(file, SERVER + ports)) == 2
    clients = "rtc3d: {enabled: true, ports: {lab: 4001, hall: 4001, gym: 4001}}\n"
    assert len(refused(file, SERVER + clients)) == 2
    assert len(refused(file, SERVER + "  - {name: LAB, host: x}\n  - {name: Lab, host: x}\n")) == 2


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("udpm://239.255.76.67:7667?ttl=300", ["ttl", "255"]),
        ("udpm://239.255.76.67:7667?ttl=-1", ["ttl", "255"]),
        ("udpm://239.255.76.67:7667?ttl=", ["ttl", "255"]),
        ("udpm://239.255.76.67:7667?ttl=²", ["ttl", "255"]),
        ("mpudpm://239.255.76.67:7667?ttl=300", ["ttl", "255"]),
        ("udpm://239.255.76.67:7667?ttl=1&recv_buf_size=2MB", ["recv_buf_size"]),
        ("udpm://239.255.76.67:7667?tttl=1", ["tttl", "'ttl'"]),
        ("udpm://239.255.76.67:7667?TTL=1", ["TTL", "'ttl'"]),
        ("udpm://192.0.2.20:7667?ttl=1", ["multicast", "239.255.255.255"]),
        ("udpm://lab-pc:7667", ["multicast"]),
        ("mpudpm://192.0.2.20:7667", ["multicast"]),
        ("udpm://239.255.76.67:0", ["65535"]),
        ("udpm://239.255.76.67:70000", ["65535"]),
        ("udpm://239.255.76.67:lcm", ["65535"]),
        ("udpm://239.255.76.67:07667", ["65535"]),
        ("udpm://239.255.76.67?ttl=1", ["65535"]),
        ("udpm://:7667", ["multicast"]),
        ("udpm://239.255.76.67:7667?ttl=010", ["ttl", "255"]),
        ("udpm://239.255.76.67:7667?ttl=1%30", ["ttl", "255"]),
        ("udpm://239.255.76.67:7667?t%74l=1", ["t%74l"]),
        ("udpm://239.255.76.67:7667#ttl=1", ["#"]),
        ("mpudpm://239.255.76.67:7667?tttl=1", ["tttl", "'ttl'"]),
    ],
)
@pytest.mark.parametrize("key", ["url", "queries_url"])
def test_a_multicast_url_that_lcm_does_not_use_as_written_is_refused(
    file: Path, key: str, url: str, words: list[str]
) -> None:
    """LCM ignores a misspelt ttl, so that messages stay on the computer, and only prints what it refuses."""
    [found] = refused(file, f"{SERVER}lcm: {{{key}: '{url}'}}\n")
    assert found.startswith(f"4:{9 + len(key)}: lcm.{key}: ")
    assert names(found, *words)


@pytest.mark.parametrize(
    "url",
    [
        "udpm://",
        "udpm://?ttl=1&recv_buf_size=2000000",
        "udpm://239.1.2.3:7000",
        "udpm://224.0.0.9:65535?ttl=255",
        "udpm://239.255.76.67:7667?transmit_only=true",
        "mpudpm://239.255.76.67:7667?ttl=1&nports=4",
        "memq://",
        "tcpq://192.0.2.20:7700",
        "file:///tmp/lcm.log?mode=w",
    ],
)
def test_urls_that_lcm_accepts_are_accepted(url: str) -> None:
    """Of other schemes, and with every parameter of LCM."""
    assert LcmSettings(url=url).url == url


@pytest.mark.parametrize(("line", "error"), MISTAKES, ids=[line[:30] for line, _ in MISTAKES])
def test_a_mistake_is_told_with_its_place(file: Path, line: str, error: str) -> None:
    [found] = refused(file, f"{SERVER}{line}\n")
    assert found.startswith(error)


def test_a_key_of_an_earlier_version_is_refused_with_what_to_write_instead(file: Path) -> None:
    """After an update, whoever runs the gateway sees each line to change, in the file and in variables."""
    [found] = refused(file, f"{SERVER}metrics: {{address: 0.0.0.0}}\n")
    assert found.startswith("4:11: metrics.address: ")
    assert names(found, "write host")
    file.write_text(SERVER)
    with pytest.raises(ConfigError, match=r"^RTC3D_GATEWAY__METRICS__ADDRESS: metrics.address: .*write host"):
        read(file, MODEL, {"RTC3D_GATEWAY__METRICS__ADDRESS": "127.0.0.2"})


def test_all_mistakes_are_told_in_the_files_order(file: Path) -> None:
    text = "lcm: {enable: true}\nzenoh: {prefix: /mocap}\nsources:\n  - host: two words\n    port: 70000\n"
    assert [re.split("; | \\(", line)[0] for line in refused(file, text)] == [
        "1:7: lcm.enable: unknown key",
        "2:17: zenoh.prefix: found '/mocap'",
        "4:5: sources[0].name: missing",
        "4:11: sources[0].host: found 'two words'",
        "5:11: sources[0].port: found 70000",
    ]


def test_aliases_repeat_values_and_mistakes_are_told_where_the_value_stands(file: Path) -> None:
    """Sources of one lab often share their settings; each that has the mistake is named."""
    text = """\
sources:
  - {name: a, host: lab-a, reconnect: &patient {max_delay_s: DELAY}}
  - {name: b, host: lab-b, reconnect: *patient}
"""
    file.write_text(text.replace("DELAY", "60"))
    assert [source.reconnect.max_delay_s for source in load(file).sources] == [60.0, 60.0]
    found = [line.partition(" found 0;")[0] for line in refused(file, text.replace("DELAY", "0"))]
    assert found == [f"2:62: sources[{number}].reconnect.max_delay_s:" for number in (0, 1)]


def test_aliases_that_grow_without_bound_are_refused(file: Path) -> None:
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 20)]
    [line] = refused(file, "\n".join(rows))
    assert names(line, "5000 values", "32 levels")


def test_a_date_is_a_name_and_a_byte_order_mark_is_no_mistake(file: Path) -> None:
    """YAML would read the date as one, and some editors on Windows write the mark."""
    file.write_bytes(b"\xef\xbb\xbfsources: [{name: 2026-06-01, host: lab}]")
    assert load(file).sources[0].name == "2026-06-01"


UMLAUTS = SERVER.encode() + "# Männer, Münster\n".encode() + b"# M\xfcnster"


@pytest.mark.parametrize(
    ("content", "place", "values"),
    [
        ("", "empty; ", ["sources"]),
        ("# nothing yet\n", "empty; ", ["sources"]),
        ("[1]", "1:1: ", ["list", SECTIONS]),
        ("text", "1:1: ", ["'text'", SECTIONS]),
        ("~", "1:1: ", ["nothing", SECTIONS]),
        ("lcm: {}", "1:1: sources: ", ["missing"]),
        (b"# M\xfcnster", "1:4: ", ["0xFC", "UTF-8"]),
        (b"\xef\xbb\xbf# M\xfcnster", "1:4: ", ["0xFC", "UTF-8"]),
        (UMLAUTS, "5:4: ", ["0xFC", "UTF-8"]),
        (SERVER + "#" * (MAX_FILE_BYTES - len(SERVER) + 1), "", [262144, "config/gateway.yaml"]),
    ],
    ids=range(10),
)
def test_a_file_that_is_no_configuration_is_refused(
    file: Path, content: str | bytes, place: str, values: list[object]
) -> None:
    """The position is that of the first wrong character, as an editor counts."""
    [line] = refused(file, content)
    assert line.startswith(place)
    assert names(line, *values)


def test_a_file_of_the_largest_size_is_loaded_and_a_missing_one_is_refused(file: Path) -> None:
    assert names(refused(file)[0], os.strerror(errno.ENOENT), "config/gateway.yaml")
    file.write_text(SERVER + "#" * (MAX_FILE_BYTES - len(SERVER)))
    assert load(file)


@pytest.mark.parametrize(("count", "more"), [(20, []), (21, [1]), (4000, [3980])])
def test_only_the_first_mistakes_are_listed(file: Path, count: int, more: list[int]) -> None:
    """Nobody reads more than twenty, and at a reload each is a line in the log."""
    lines = refused(file, SERVER + "lcm:\n" + "".join(f"  key{number}: 1\n" for number in range(count)))
    assert lines[19].startswith("24:3: lcm.key19: unknown key")
    assert len(lines[20:]) == len(more)
    assert all(names(line, number) for line, number in zip(lines[20:], more, strict=True))


def test_a_file_has_at_most_5000_values(file: Path) -> None:
    """The limit protects from aliases that grow; eight of them are not in the list here."""
    text = f"{SERVER}zenoh: {{config: {{metadata: [{', '.join('x' * 4992)}]}}}}"
    file.write_text(text)
    assert load(file)
    assert "more than 5000 values" in refused(file, text.replace("x]", "x, x]"))[0]


@pytest.mark.parametrize("name", ["zenoh.json5", "zenoh.yaml"])
def test_zenohs_file_with_deep_nesting_is_refused(file: Path, name: str) -> None:
    """Zenoh's own parser overflows the stack, which ends the process."""
    (file.parent / name).write_text("{a: " + "[" * 100_000 + "]" * 100_000 + "}")
    [line] = refused(file, f"{SERVER}zenoh: {{config: {name}}}")
    assert names(line, "line 1, column 68", 64)


def test_zenohs_file_may_have_brackets_in_texts_and_comments(file: Path) -> None:
    many = "[" * 1000
    text = f"// {many}\n{{mode: 'client', /* {many} \n */ metadata: {{a: '{many}\\'{many}'}}}}"
    (file.parent / "zenoh.json5").write_text(text)
    file.write_text(f"{SERVER}zenoh: {{config: zenoh.json5}}")
    load(file)


def test_zenohs_file_is_looked_for_beside_this_one(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file.write_text(f"{SERVER}zenoh: {{config: net/zenoh.json5}}\n")
    zenoh_file = file.parent / "net" / "zenoh.json5"
    zenoh_file.parent.mkdir()
    zenoh_file.write_text("{mode: 'client'} // JSON5")
    assert load(file).zenoh == ZenohSettings(config=zenoh_file)
    monkeypatch.chdir(file.parent)
    assert load(Path(file.name)).zenoh.config == zenoh_file
    zenoh_file.write_text("{mode: 'clint'}")
    [line] = refused(file)
    assert line.startswith("4:17: zenoh.config: ")
    assert names(line, zenoh_file, "`clint`")
    zenoh_file.unlink()
    assert names(refused(file)[0], zenoh_file, "No such file or directory")


def test_a_drawing_of_zenoh_is_put_on_one_line(file: Path) -> None:
    """A log has lines; and a pipe would block the gateway for ever."""
    os.mkfifo(file.parent / "pipe")
    assert names(refused(file, f"{SERVER}zenoh: {{config: pipe}}")[0], "pipe")
    (file.parent / "zenoh.json5").write_text("{mode: 'peer',,\n}")
    [line] = refused(file, f"{SERVER}zenoh: {{config: zenoh.json5}}\n")
    assert names(line, file.parent / "zenoh.json5", "line 1, column 15")


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))


def _huge(path: Path) -> None:
    path.touch()
    os.truncate(path, 2**40)


@pytest.mark.parametrize(
    ("make", "problem"),
    [
        (os.mkfifo, "pipe"),
        (Path.mkdir, "folder"),
        (_socket, "socket"),
        (lambda path: path.symlink_to("/dev/zero"), "device"),
        (lambda path: path.symlink_to("/dev/null"), "device"),
        (lambda path: path.symlink_to("missing"), "No such file or directory"),
        (lambda path: path.symlink_to(path), "Too many levels of symbolic links"),
        (lambda path: path.touch(), None),
        (_huge, "262144 bytes"),
    ],
)
def test_what_is_no_small_file_is_refused_at_once(
    tmp_path: Path, make: Callable[[Path], None], problem: str | None
) -> None:
    path = tmp_path / "lab.yaml"
    make(path)
    if problem is None:
        assert read_file(path) == b""
    else:
        with pytest.raises(OSError, match=problem):
            read_file(path)
