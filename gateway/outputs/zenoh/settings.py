"""The section ``zenoh`` of the configuration, and the output in the registry."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Final

import zenoh
from pydantic import AfterValidator, Field, PlainValidator, ValidationInfo
from typing_extensions import override

from gateway.config.section import expects, validation_error
from gateway.config.settings import OutputSettings
from gateway.config.values import ByteLimit, MaxRates, QueryRate, Switch
from gateway.config.words import describe
from gateway.outputs.kind import OutputKind, imported_late
from gateway.outputs.zenoh.config import read_zenoh_config, zenoh_config, zenoh_reason

DEFAULT_ZENOH_PREFIX: Final = "mocap"


JsonRate = Annotated[
    float,
    Field(strict=True, ge=0, le=1000, allow_inf_nan=False),
    expects("0 for no JSON, or a number of messages per second up to 1000"),
]


def _key_prefix(text: str) -> str:
    if len(text) > 128 or not all(text.split("/")) or not text.isprintable() or re.search(r"[\s*$#?]", text):
        raise ValueError
    return text


KeyPrefix = Annotated[
    str,
    AfterValidator(_key_prefix),
    expects(
        "a Zenoh key of at most 128 characters, such as mocap or site/mocap, "
        "without spaces, * $ # ?, and without a leading, trailing or double /"
    ),
]


def _zenoh_config(value: object, info: ValidationInfo) -> Path | dict[str, Any]:
    """Return the path of Zenoh's configuration, or its keys, after Zenoh itself has checked them.

    A relative path is relative to ``folder`` in the validation context; without a folder, no file is read.
    """
    match value:
        case dict():
            _ask_zenoh(lambda: zenoh.Config.from_json5(json.dumps(value, allow_nan=False)), "these keys")
            return value
        case Path():
            return value
        case str() if value and value.isprintable():
            folder: Path | None = (info.context or {}).get("folder")
            if folder is None:
                return Path(value)
            path = folder / value
            _ask_zenoh(lambda: read_zenoh_config(path), f"the file {path}")
            return path
    raise validation_error(
        f"found {describe(value)}; expected a JSON5 file's path or a mapping with Zenoh's own keys"
    )


def _ask_zenoh(read: Callable[[], object], what: str) -> None:
    try:
        read()
    except (OSError, zenoh.ZError, TypeError, ValueError) as error:
        raise validation_error(f"Zenoh refuses {what}: {zenoh_reason(error)}") from None


ZenohConfig = Annotated[
    Path | dict[str, Any], PlainValidator(_zenoh_config, json_schema_input_type=str | dict[str, Any])
]
"""YAML: a path, or a mapping."""


_CERTIFICATES: Final = ("root_ca_certificate", "listen_certificate", "connect_certificate")
"""The keys of Zenoh's transport/link/tls that name files with certificates."""


class ZenohSettings(OutputSettings):
    """The settings of the Zenoh output."""

    foreign_keys: ClassVar[Mapping[str, str]] = {
        "config": "zenoh.config as the path of a JSON5 file that only the gateway may read"
    }

    enabled: Switch = True
    """Whether to publish, and to answer queries, on Zenoh."""

    prefix: KeyPrefix = DEFAULT_ZENOH_PREFIX
    """The beginning of all keys."""

    config: ZenohConfig = Field(default_factory=dict, repr=False)  # it may hold a password
    """The configuration of Zenoh itself: the path of a JSON5 file, or its keys inline, without secrets."""

    express: Switch = False
    """Whether to send each message at once instead of in batches."""

    max_rate_hz: MaxRates = {}  # noqa: RUF012 - pydantic copies defaults
    """The highest rate of each listed component, in Hz; further frames are left out at even intervals."""

    json_max_rate_hz: JsonRate = 30.0
    """How many messages a second to publish as JSON on each key …/json, while someone subscribes to it."""

    tool_poses: Switch = False
    """Whether to publish the pose of each tool on its own key, while someone subscribes to it."""

    max_queries_per_s: QueryRate = 2000.0
    """How many queries a second to answer. Beyond this limit or the next two, they get the error rate."""

    max_queries_per_key_per_s: QueryRate = 1000.0
    """How many queries a second to answer for each key, or selector with wildcards."""

    max_reply_bytes_per_s: ByteLimit = 16 * 1024 * 1024
    """How many bytes a second to send in replies. Those above 512 KiB, and the history's, count apart."""

    @property
    @override
    def certificates(self) -> Mapping[str, Path]:
        """Reads the file of Zenoh's configuration; raises ConfigError."""
        tls = json.loads(zenoh_config(self.config).get_json("transport/link/tls"))
        return {key: Path(tls[key]) for key in _CERTIFICATES if tls[key]}


ZENOH: Final = OutputKind(
    name="zenoh",
    settings=ZenohSettings,
    create=imported_late("gateway.outputs.zenoh.output:ZenohOutput"),
    subscribe=imported_late("gateway.outputs.zenoh.subscriber:subscribe"),
    checks=("link", "routers", "gateway"),
    run_checks=imported_late("gateway.outputs.zenoh.checks:check_zenoh"),
    leaves_host=imported_late("gateway.outputs.zenoh.checks:leaves_host"),
    open_ports=imported_late("gateway.outputs.zenoh.open_ports:open_ports"),
    demo=imported_late("gateway.outputs.zenoh.subscriber:demo"),
)
