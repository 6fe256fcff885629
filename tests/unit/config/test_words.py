import copy
import logging
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

from gateway.config.document import variable_name
from gateway.config.loading import shown_configuration
from gateway.config.words import find_secrets, replace_item
from gateway.errors import ConfigError
from gateway.outputs.zenoh.config import zenoh_reason
from gateway.outputs.zenoh.output import ZenohOutput
from tests.support.configurations import load, read
from tests.support.errors import names, raises
from tests.support.networks import free_port
from tests.support.waiting import wait_until

SERVER = "sources: [{name: lab, host: 192.0.2.20}]\n"
PASSWORD = variable_name(("zenoh", "config", "transport", "auth", "usrpwd", "password"))
PEM = "-----BEGIN EC PRIVATE KEY-----\ngeheim\n-----END EC PRIVATE KEY-----\n"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "lab.yaml"


SECRETS = [
    # Zenoh's keys in YAML, with the word SECRET for what is masked.
    "{transport: {auth: {usrpwd: {user: me, password: 'SECRET'}}}}",
    "{transport: {auth: {pubkey: {public_key_pem: P, private_key_pem: 'SECRET'}}}}",
    "{transport: {link: {tls: {listen_private_key_base64: 'SECRET', connect_private_key: /k}}}}",
    "{connect: {endpoints: ['tcp/a:1', 'tls/a:1#connect_private_key_raw=SECRET;so_sndbuf=1']}}",
    "{plugins: {x: {url: 'https://me:SECRET@lab:1/geheim.txt', token_secret: 'SECRET'}}}",
]


@pytest.mark.parametrize(
    ("config", "seen"),
    [
        *(
            (yaml.safe_load(re.sub("SECRET", "geheim", text)), yaml.safe_load(re.sub("SECRET", "***", text)))
            for text in SECRETS
        ),
        (
            {"plugins": {"influx": {"private": {"username": "me"}}}},
            {"plugins": {"influx": {"private": "***"}}},
        ),
        ({"plugins": {"x": {"pem": PEM}}}, {"plugins": {"x": {"pem": "***\n"}}}),
    ],
)
def test_secrets_are_masked(config: dict[str, Any], seen: dict[str, Any]) -> None:
    assert list(find_secrets(config))
    for values in (config, copy.deepcopy(seen)):  # masking again changes nothing
        for location, masked in list(find_secrets(values)):
            replace_item(values, location, masked)
        assert values == seen


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "{transport: {auth: {usrpwd: {user: me, password: null, dictionary_file: /etc/users}}}}",
        "{transport: {link: {tls: {listen_private_key: /k, root_ca_certificate_base64: x}}}}",
        "{connect: {endpoints: ['tcp/lab:7447', 'tcp/[::1]:7447#so_sndbuf=1']}, metadata: {name: 'a:b@c'}}",
    ],
)
def test_what_is_no_secret_stays(text: str) -> None:
    assert list(find_secrets(yaml.safe_load(text))) == []


@pytest.mark.parametrize(
    ("config", "column", "path", "instead"),
    [
        ("auth: {usrpwd: {user: me, password: geheim}}", 66, "auth.usrpwd.password", []),
        ("auth: {usrpwd: {user: me, password: 1234567}}", 66, "auth.usrpwd.password", []),
        (
            "link: {tls: {connect_private_key_base64: geheim}}",
            71,
            "link.tls.connect_private_key_base64",
            ["connect_private_key"],
        ),
        (
            "auth: {pubkey: {private_key_pem: geheim}}",
            63,
            "auth.pubkey.private_key_pem",
            ["private_key_file"],
        ),
    ],
)
def test_a_secret_in_the_file_is_refused(
    file: Path, config: str, column: int, path: str, instead: list[str]
) -> None:
    file.write_text(f"{SERVER}zenoh: {{config: {{transport: {{{config}}}}}}}\n")
    with pytest.raises(ConfigError) as caught:
        load(file, {})
    variable = f"RTC3D_GATEWAY__ZENOH__CONFIG__TRANSPORT__{path.replace('.', '__').upper()}"
    assert str(caught.value).startswith(f"{file}:2:{column}: zenoh.config.transport.{path}: ")
    assert names(str(caught.value), *instead, variable)


def test_a_secret_in_an_endpoint_in_the_file_is_refused(file: Path) -> None:
    file.write_text(
        f"{SERVER}zenoh: {{config: {{connect: {{endpoints: ['tls/a:1#x_private_key_raw=geheim']}}}}}}\n"
    )
    with pytest.raises(
        ConfigError, match=r":2:40: zenoh.config.connect.endpoints\[0\]: .*CONNECT__ENDPOINTS__0,"
    ):
        load(file, {})


def test_a_secret_is_told_with_the_other_mistakes(file: Path) -> None:
    config = "{mode: clint, transport: {auth: {usrpwd: {password: geheim}}}}"
    file.write_text(f"lcm: 1\n{SERVER}zenoh: {{config: {config}}}\n")
    with pytest.raises(ConfigError) as caught:
        load(file, {})
    places = [line.split(": ")[1] for line in str(caught.value).splitlines()]
    assert places == ["lcm", "zenoh.config", "zenoh.config.transport.auth.usrpwd.password"]
    assert "geheim" not in str(caught.value)


@pytest.mark.parametrize("password", ["geheim", "12345678", "null", "a: {b", "#x", " ", "*a", "'"])
def test_a_password_from_the_environment_is_text_as_it_stands(file: Path, password: str) -> None:
    file.write_text(f"{SERVER}zenoh: {{config: {{transport: {{auth: {{usrpwd: {{user: me}}}}}}}}}}\n")
    configuration = read(file, {PASSWORD: password})
    usrpwd = configuration.settings.model_dump()["zenoh"]["config"]["transport"]["auth"]["usrpwd"]
    assert usrpwd == {"user": "me", "password": password}
    shown = [" ".join(line.split()) for line in shown_configuration(configuration).splitlines()]
    assert f"password: '***' # {PASSWORD}" in shown
    assert "geheim" not in repr(configuration.settings)


def test_half_a_character_in_a_password_is_refused(file: Path) -> None:
    file.write_text(SERVER)
    with raises(ConfigError, PASSWORD, "UTF-8"):
        load(file, {PASSWORD: "\udcff"})


@pytest.mark.parametrize(
    "content",
    [
        "{transport: {auth: {usrpwd: {user: 'u', password: 'geheim' xx}}}}",  # the line is drawn
        "{transport: {auth: {usrpwd: {user: 'u', password: 4711}}}}",  # the value is told
        "{transport: {auth: {usrpwd: 'geheim'}}}",
        "{connect: {endpoints: ['tls lab#connect_private_key_raw=geheim']}}",
    ],
)
def test_zenohs_errors_quote_no_secrets(file: Path, content: str) -> None:
    (file.parent / "zenoh.json5").write_text(content)
    file.write_text(f"{SERVER}zenoh: {{config: zenoh.json5}}\n")
    with pytest.raises(ConfigError) as caught:
        load(file, {})
    assert names(str(caught.value), file.parent / "zenoh.json5")
    assert "geheim" not in str(caught.value)
    assert "4711" not in str(caught.value)


def test_zenohs_reasons_keep_what_helps() -> None:
    drawing = (
        " --> 2:7\n  |\n2 |  mode: 'geheim',,\n  |       ^---\n  |\n  = expected identifier\n at src/a.rs:1."
    )
    message = r'Message { msg: "no field `a\"b`", location: Some(Location { line: 2, column: 7 }) }'
    text = 'invalid type: string "ge\\"heim", expected a boolean at /x/y.rs:615.'
    assert [zenoh_reason(ValueError(each)) for each in (drawing, message, text)] == [
        "line 2, column 7: expected identifier",
        'line 2, column 7: no field `a"b`',
        "invalid type: string, expected a boolean",
    ]


def test_a_link_that_fails_is_told_without_its_key(caplog: pytest.LogCaptureFixture, file: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}#connect_private_key_base64=geheim"
    file.write_text(SERVER + "zenoh: {config: {mode: client, scouting: {multicast: {enabled: false}}}}\n")
    settings = load(file, {"RTC3D_GATEWAY__ZENOH__CONFIG__CONNECT__ENDPOINTS": f"['{endpoint}']"})
    caplog.set_level(logging.DEBUG)
    output = ZenohOutput(settings.zenoh)
    output.start()
    try:
        wait_until(lambda: "does not open" in output.health().problem)
        assert "connect_private_key_base64=***" in output.health().problem
        assert "geheim" not in output.health().problem + caplog.text
    finally:
        output.close()
