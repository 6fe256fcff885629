"""Zenoh's own configuration, also for the sessions of commands, and readable texts of Zenoh's errors."""

import json
import os
import re
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import zenoh

from gateway.config.document import line_and_column_after
from gateway.config.files import read_file
from gateway.config.words import mask_secrets_in_text
from gateway.errors import ConfigError

_ZENOH_MESSAGE: Final = re.compile(
    r'Message \{ msg: "((?:[^"\\]|\\.)*)", location: Some\(Location \{ line: (\d+), column: (\d+)'
)
"""The Rust debug text by which Zenoh reports a value in a file that it cannot use."""

_MAX_DEPTH: Final = 64
"""The maximum number of nested brackets in a file: Zenoh's parser overflows the stack at a few thousand."""

_JSON5_TOKEN: Final = re.compile(
    r"""(?P<skipped>"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|//[^\n]*|/\*.*?\*/)|(?P<open>[\[{])|(?P<close>[]}])""",
    re.DOTALL,
)

_DEFAULTS: Final = {
    "transport": {
        # 16 MB of /dev/shm, and files left behind after a kill, for messages of a few kB.
        "shared_memory": {"enabled": False},
        "link": {
            "tx": {
                "queue": {
                    # How many batches of 48 kB wait for a subscriber; 16 is the largest number. Zenoh's
                    # own 2 are full when the scheduler delays a subscriber by a few ms.
                    "size": {"data": 16},
                    # How long, in µs, a put waits for each subscriber whose queue is full, before Zenoh
                    # drops messages for it: once, then again after each batch that it has read. A put waits
                    # for one after the other, and nobody gets messages meanwhile. So with 20 ms, 30
                    # subscribers that stop reading would stop the gateway for 0.6 s.
                    # The second value is for each message that is longer than a batch.
                    "congestion_control": {
                        "drop": {"wait_before_drop": 200, "max_wait_before_drop_fragments": 5_000}
                    },
                }
            }
        },
    },
    # Caches for late subscribers need samples with time stamps.
    "timestamping": {"enabled": True},
    # Reconnects to a lost router within 0.5 s instead of up to 4 s.
    "connect": {"retry": {"period_init_ms": 200, "period_max_ms": 500, "period_increase_factor": 1.5}},
}
"""The gateway's defaults where they differ from Zenoh's; an inline configuration overrides them."""

_THREADS: Final = "(tx: (worker_threads: 4), net: (worker_threads: 4))"
"""The threads of Zenoh that send, in the form of its environment variable ZENOH_RUNTIME.

With its default of one each, Zenoh sent nothing to anybody for 5 s while it closed the link of a peer that
had asked and did not read the answers. Each thread of the gateway that sends answers can wait for one such
link at a time.
"""


def prepare_threads() -> None:
    """Let Zenoh have _THREADS, unless the environment says otherwise. Call it before the first session."""
    os.environ.setdefault("ZENOH_RUNTIME", _THREADS)


def zenoh_config(config: Path | Mapping[str, Any]) -> zenoh.Config:
    """Return Zenoh's configuration from a JSON5 file, unchanged, or from inline keys over _DEFAULTS.

    Raises ConfigError with Zenoh's reason.
    """
    try:
        if isinstance(config, Path):
            return read_zenoh_config(config)
        return zenoh.Config.from_json5(json.dumps(_merged(_DEFAULTS, config)))
    except (OSError, zenoh.ZError, TypeError, ValueError) as error:
        where = f"file {config}" if isinstance(config, Path) else "inline zenoh.config"
        raise ConfigError(f"Zenoh does not accept the {where}: {zenoh_reason(error)}") from error


def read_zenoh_config(path: Path) -> zenoh.Config:
    """Return Zenoh's configuration from a file.

    Raises OSError if the file cannot be read; ZError, TypeError or ValueError if Zenoh cannot use it.
    """
    text = read_file(path).decode("utf-8", "replace")  # Zenoh reports what is not UTF-8
    depth = 0
    for token in _JSON5_TOKEN.finditer(text):
        depth += (token.lastgroup == "open") - (token.lastgroup == "close")
        if depth > _MAX_DEPTH:
            line, column = line_and_column_after(text[: token.start()])
            raise ValueError(f"line {line}, column {column}: found more than {_MAX_DEPTH} nested brackets")
    return zenoh.Config.from_file(str(path))


def _merged(defaults: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(defaults)
    for key, value in given.items():
        default = merged.get(key)
        if isinstance(default, Mapping) and isinstance(value, Mapping):
            merged[key] = _merged(default, value)
        else:
            merged[key] = value
    return merged


def zenoh_reason(error: Exception) -> str:
    """Return the text of Zenoh's error on one line, without source locations and without secrets."""
    text = (error.strerror if isinstance(error, OSError) else None) or str(error)
    if message := _ZENOH_MESSAGE.search(text):
        text = f"line {message[2]}, column {message[3]}: " + re.sub(r"\\(.)", r"\1", message[1])
    text = re.sub(r"\s+at \S+\.rs:\d+\.?", "", text)
    # Zenoh quotes the line that it cannot parse, which may contain a password. Keep only the position and
    # what was expected. Of a value with the wrong type, keep the type, not the value.
    text = re.sub(r"^ *--> (\d+):(\d+)", r"line \1, column \2:", text)
    text = re.sub(r"^ *(\d+ )?\|.*\n|^ *= ", "", text, flags=re.MULTILINE)
    text = re.sub(r"(invalid (?:type|value): [a-z ]+) (?:`[^`]*`|\"(?:[^\"\\]|\\.)*\")", r"\1", text)
    text = re.sub(r"\bSingle\(([^()]*)\)", r"\1", text)  # how Rust prints an endpoint without alternatives
    return " ".join(mask_secrets_in_text(text).split())


_ANY_ADDRESS: Final = re.compile(r"/(\[::\]|0\.0\.0\.0):")
_TLS: Final = "transport/link/tls"


def command_config(given: Path | Mapping[str, Any]) -> zenoh.Config:
    """Return the configuration of a session beside a gateway that uses ``given``; it may be a viewer's, too.

    The session does not listen, because a running gateway may already use the addresses. It connects to
    them instead, and shows the certificate that the gateway shows there. Rules for access control stay with
    the gateway: they would deny this session what its peers may do. Raises ConfigError if Zenoh does not
    accept ``given``.
    """
    config = zenoh_config(given)
    listen = [endpoint for endpoint in endpoints(config, "listen") if not endpoint.endswith(":0")]
    mode = mode_of(config)
    config.insert_json5("access_control", '{"enabled": false, "default_permission": "allow"}')
    if json.loads(config.get_json("id")):  # two sessions with one id do not connect
        # Zenoh rejects an id that begins with 0.
        config.insert_json5("id", json.dumps(f"1{secrets.token_hex(15)}"))
    if mode != "client":
        connect = endpoints(config, "connect")
        reachable = [_ANY_ADDRESS.sub("/127.0.0.1:", endpoint) for endpoint in listen]
        if not connect and reachable != listen:  # a certificate need not contain the loopback address
            config.insert_json5(f"{_TLS}/verify_name_on_connect", "false")
        config.insert_json5("connect/endpoints", json.dumps([*connect, *reachable]))
        config.insert_json5("connect/exit_on_failure", "false")
        config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", "[]")
    tls = json.loads(config.get_json(_TLS))
    if tls["listen_certificate"] and not tls["connect_certificate"]:
        for name in ("certificate", "private_key"):
            config.insert_json5(f"{_TLS}/connect_{name}", json.dumps(tls[f"listen_{name}"]))
    return config


def mode_of(config: zenoh.Config) -> str:
    """Return the mode: client, peer or router."""
    return str(json.loads(config.get_json("mode")) or "peer")


def endpoints(config: zenoh.Config, side: str) -> list[str]:
    """Return the configured endpoints for the mode; ``side`` is connect or listen."""
    configured = json.loads(config.get_json(f"{side}/endpoints"))
    if isinstance(configured, dict) and "locators" not in configured:
        configured = configured.get(mode_of(config)) or []
    return list(_flat(configured))


def _flat(configured: Any) -> Iterator[str]:
    match configured:
        case str():
            yield configured
        case {"locators": locators}:
            yield from _flat(locators)
        case list():
            for endpoint in configured:
                yield from _flat(endpoint)
