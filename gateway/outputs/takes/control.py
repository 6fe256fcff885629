"""The key ``take`` of each source: peers start, stop, save, list and read takes with its options."""

import re
from collections.abc import Callable, Mapping
from typing import Any, Final
from urllib.parse import unquote

from gateway.errors import QueryError
from gateway.messages.decode import JSON, LOG, json_bytes
from gateway.outputs.contract import CONTROL_OPTION, READ_OPTION, Answer
from gateway.outputs.takes.folder import StoredTake
from gateway.outputs.takes.source_takes import MAX_SAVED_S, SourceTakes
from gateway.runtime.safe_text import quoted
from gateway.runtime.token_bucket import TokenBucket
from gateway.takes.files.description import MAX_DETAIL_CHARACTERS, TakeDetails

MAX_LISTED: Final = 1000
"""How many takes a list has, the newest."""

READS_PER_S: Final = 100.0
"""How many pieces of takes a second are read from the disk, for all peers."""

_OPTIONS: Final[Mapping[str, tuple[str, ...]]] = {
    "": (),
    "start": ("name", *MAX_DETAIL_CHARACTERS),
    "stop": (),
    "save": ("last", "after", "name", *MAX_DETAIL_CHARACTERS),
    READ_OPTION: (READ_OPTION, "offset"),
}
"""What peers can ask for, with the options that each takes; "" is the list."""

_ACCEPTED: Final = (
    "none for a list, set=start;name=NAME, set=stop, set=save;last=SECONDS;after=SECONDS;name=NAME, "
    "read=NAME;offset=BYTES; with start and save also subject=TEXT;session=TEXT;note=TEXT"
)


class TakeCommand:
    """The command ``take`` of the output: checks the options, and asks ``takes`` of the source."""

    def __init__(self, takes: Callable[[str], SourceTakes], monotonic: Callable[[], float]) -> None:
        self._takes = takes
        self._reads = TokenBucket(READS_PER_S, monotonic=monotonic)

    async def __call__(self, source: str, options: Mapping[str, str]) -> Answer:
        """Implement Command (outputs/contract.py)."""
        action = _action(options)
        match action:
            case "start":
                take = await self._takes(source).start(options.get("name", ""), _details(options))
            case "stop":
                take = await self._takes(source).stop()
            case "save":
                take = await self._takes(source).save(
                    _seconds(options, "last", MAX_SAVED_S, default=MAX_SAVED_S),
                    _seconds(options, "after", MAX_SAVED_S, default=0.0),
                    options.get("name", ""),
                    _details(options),
                )
            case "read":
                return await self._read(source, options[READ_OPTION], _offset(options))
            case _:
                return await self._list(source)
        return Answer(json_bytes({"source": source, **_fields(take)}), JSON)

    async def _list(self, source: str) -> Answer:
        found = await self._takes(source).list()
        content = {
            "source": source,
            "running": None if found.running is None else _fields(found.running),
            "takes": [_fields(take) for take in found.takes[:MAX_LISTED]],
            "num_takes": len(found.takes),
            "kept_s": round(found.kept_s, 3),
        }
        return Answer(json_bytes(content), JSON)

    async def _read(self, source: str, name: str, offset: int) -> Answer:
        if not self._reads.try_take():
            raise QueryError(
                f"the gateway reads {READS_PER_S:g} pieces of takes a second; try again", code="rate"
            )
        piece = await self._takes(source).read(name, offset)
        return Answer(
            piece.content, LOG, {"name": piece.name, "bytes": piece.num_bytes, "offset": piece.offset}
        )


def _fields(take: StoredTake) -> dict[str, Any]:
    return {
        "name": take.name,
        "bytes": take.num_bytes,
        "begin_utime": take.begin_utime,
        "seconds": round(take.seconds, 3),
        "is_running": take.is_running,
        "lost": take.num_lost,
        "is_cut_off": take.is_cut_off,
        **take.details._asdict(),
    }


def _action(options: Mapping[str, str]) -> str:
    """Return start, stop, save, read, or "" for the list. Raises QueryError for wrong options."""
    action = options.get(CONTROL_OPTION, READ_OPTION if READ_OPTION in options else "")
    if CONTROL_OPTION in options and action not in {"start", "stop", "save"}:
        raise QueryError(f"set={quoted(action)} is not accepted; accepted: start, stop, save")
    for option in options.keys() - {CONTROL_OPTION}:
        if option not in _OPTIONS[action]:
            what = f"take with set={action}" if CONTROL_OPTION in options else "take"
            raise QueryError(f"unknown option {quoted(option)} of {what}; accepted: {_ACCEPTED}")
    return action


def _seconds(options: Mapping[str, str], option: str, maximum_s: float, *, default: float) -> float:
    text = options.get(option)
    if text is None:
        return default
    if not re.fullmatch(r"[0-9]{1,9}(\.[0-9]{0,9})?", text) or float(text) > maximum_s:
        raise QueryError(
            f"{option}={quoted(text)} is not accepted; accepted: a number of seconds up to {maximum_s:g}"
        )
    return float(text)


def _details(options: Mapping[str, str]) -> TakeDetails:
    """Return what a take is about. %3B stands for a semicolon, which ends an option, and %25 for %."""
    texts = {}
    for name in options.keys() & MAX_DETAIL_CHARACTERS.keys():
        try:
            texts[name] = unquote(options[name], errors="strict")
        except UnicodeDecodeError:
            raise QueryError(
                f"{name}={quoted(options[name])} is not accepted; accepted: UTF-8 after each %"
            ) from None
    return TakeDetails(**texts).checked()


def _offset(options: Mapping[str, str]) -> int:
    text = options.get("offset", "0")
    if not re.fullmatch("[0-9]{1,18}", text):
        raise QueryError(f"offset={quoted(text)} is not accepted; accepted: a number of bytes")
    return int(text)
