"""Calls of outputs that may raise although the contract forbids it: a defect in one must not stop others."""

from collections.abc import Callable, Mapping
from logging import getLogger
from typing import Final, TypeVar
from weakref import WeakKeyDictionary

from gateway.log import DefectLog, defect_text
from gateway.outputs.contract import Output
from gateway.outputs.status import OutputHealth

_Result = TypeVar("_Result")

_defects: Final[WeakKeyDictionary[Output, DefectLog]] = WeakKeyDictionary()

logger = getLogger(__name__)


def guarded(output: Output, call: Callable[[], _Result], otherwise: _Result) -> _Result:
    """Return what ``call`` returns. If it raises, log the defect of ``output`` and return ``otherwise``."""
    try:
        return call()
    except Exception as defect:  # noqa: BLE001 - other outputs continue
        log_defect(output, defect)
        return otherwise


def health(output: Output) -> OutputHealth:
    """Return the health of an output; a defect in finding it out is a problem of the output."""
    try:
        return output.health()
    except Exception as defect:  # noqa: BLE001 - other outputs continue
        log_defect(output, defect)
        return OutputHealth(False, f"{defect_text(defect)}; report this with the log")


def query_results(output: Output, source: str) -> Mapping[str, int]:
    """Return the number of queries about ``source`` by result; empty if the output answers none."""
    results = guarded(output, lambda: output.query_results, None) or {}
    return results.get(source, {})


def log_defect(output: Output, defect: Exception) -> None:
    """Log a defect of ``output``, with its traceback the first time."""
    _defects.setdefault(output, DefectLog(logger, output.name)).log(defect)
