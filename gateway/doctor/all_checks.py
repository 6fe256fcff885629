"""All checks, layer by layer, so that a fault is found before its consequences."""

import ctypes
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from functools import partial
from typing import Final

from gateway.config.settings import OutputSettings, Settings
from gateway.doctor import gateway_checks, source_checks
from gateway.doctor.gateway_checks import HealthReport, address_text, check_gateway, read_health
from gateway.doctor.source_checks import SourceChecks
from gateway.errors import ConfigError
from gateway.outputs.findings import NO_CONFIGURATION, Check, Finding, MessageLoad, as_sentence
from gateway.outputs.kind import OPENS, OutputKind
from gateway.outputs.registry import OUTPUTS, UNUSABLE
from gateway.workers import WorkerThread

_POLL_S: Final = 0.05


def check_output(
    kind: OutputKind,
    settings: OutputSettings,
    sources: Sequence[str],
    loads: Sequence[MessageLoad],
    seconds: float,
) -> list[Finding]:
    """Run the checks of one output, or check that it opens, as in the gateway. Blocks for about ``seconds``.

    ``sources`` are the names of all sources, ``loads`` the messages that they make.
    """
    if not settings.enabled:
        reason = f"{kind.name}.enabled is false"
        return [Check(kind.name, check).not_tested(reason) for check in kind.checks]
    if kind.run_checks is not None:
        return kind.run_checks(settings, sources, loads, seconds)
    check = Check(kind.name, OPENS)
    default_remedy = f"Correct {kind.name} in the configuration."
    try:
        output = kind.create(settings)
    except ConfigError as error:
        return [check.failing(str(error), default_remedy)]
    output.start()
    deadline_s = time.monotonic() + seconds
    while not output.health().connected and time.monotonic() < deadline_s:
        time.sleep(_POLL_S)
        output.maintain()
    health = output.health()
    output.close()
    if health.connected:
        return [check.passing("the output opens")]
    return [check.problem(health.problem, default_remedy)]


_FILE: Final = Check("configuration", "file")


async def run_checks(
    settings: Settings,
    origin: str,
    seconds: float,
    *,
    connects: bool = True,
    output_sections: Mapping[str, OutputSettings] | None = None,
) -> AsyncIterator[Finding]:
    """Run all checks, and yield each finding as soon as it is known.

    The running gateway is asked first. Then the sources are watched one after the other, each for
    ``seconds``, unless ``connects`` is False: then no connection to their servers is opened. Outputs that
    are not enabled come after the others.

    ``origin`` says where the settings come from, for example a file name. ``output_sections`` replace those
    of the settings where an output is checked.
    """
    enabled = [name for name, section in settings.outputs.items() if section.enabled]
    names = [source.name for source in settings.sources]
    yield _FILE.passing(f"{origin}: {', '.join(names)} to {', '.join(enabled)}")
    report = await read_health(settings.metrics)
    for finding in check_gateway(report, address_text(settings.metrics), names, connects=connects):
        yield finding
    loads: list[MessageLoad] = []
    for source in settings.sources:
        checks = SourceChecks(source, seconds, report if isinstance(report, HealthReport) else None)
        async for finding in checks.run() if connects else checks.run_without_connecting():
            yield finding
        loads += checks.message_loads
    sections = {**settings.outputs, **(output_sections or {})}
    for name, section in sorted(sections.items(), key=lambda item: not item[1].enabled):
        check = partial(check_output, OUTPUTS[name], section, names, loads, seconds)
        for finding in await WorkerThread(name).run(check):
            yield finding
    for name, text in UNUSABLE.items():
        found, _, remedy = text.rpartition("; ")
        yield Check(name, "package").warning(found, as_sentence(remedy))
    leaving = [name for name in enabled if OUTPUTS[name].leaves_host(settings.outputs[name])]
    yield check_clock(leaving)


def run_checks_without_settings(error: ConfigError) -> Iterator[Finding]:
    """Yield ``error`` as a finding, and run the checks that need no settings."""
    yield _FILE.failing(str(error), "Correct these lines; config/gateway.yaml explains every key.")
    subjects = {
        "running gateway": gateway_checks.CHECKS,
        "source": source_checks.CHECKS,
        **{name: kind.checks for name, kind in OUTPUTS.items()},
    }
    for subject, checks in subjects.items():
        for check in checks:
            yield Check(subject, check).not_tested(NO_CONFIGURATION)
    yield check_clock([])


_STA_UNSYNC: Final = 0x40  # linux/timex.h

_CLOCK: Final = Check("this computer", "clock")


class _Timex(ctypes.Structure):
    """The first fields of Linux's struct timex, and space for the rest."""

    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("esterror", ctypes.c_long),
        ("status", ctypes.c_int),
        ("rest", ctypes.c_byte * 256),
    )


def read_clock() -> tuple[bool, int]:
    """Return whether the kernel's clock is synchronised, and its maximum error in µs.

    Raises OSError if the kernel does not report it, as in some containers.
    """
    timex = _Timex()  # modes is 0, so adjtimex changes nothing
    libc = ctypes.CDLL(None, use_errno=True)
    if not hasattr(libc, "adjtimex"):
        raise OSError("this system has no adjtimex")
    if libc.adjtimex(ctypes.byref(timex)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex is not allowed")
    return not timex.status & _STA_UNSYNC, timex.maxerror


def check_clock(leaving: Sequence[str]) -> Finding:
    """Check that this computer's clock is synchronised.

    ``leaving`` names the outputs whose messages leave this computer. Without any, an unsynchronised clock is
    a warning: programs on this computer use the same clock.
    """
    try:
        is_synchronised, max_error_us = read_clock()
    except OSError as error:
        return _CLOCK.not_tested(f"the kernel does not report it: {error.strerror or error}")
    if is_synchronised:
        return _CLOCK.passing(f"synchronised, with an error of at most {max_error_us / 1000:.1f} ms")
    found = (
        "this computer's clock is not synchronised, so utime cannot be compared with the clocks of other "
        "computers"
    )
    remedy = (
        "Set up chrony or systemd-timesyncd with the lab's time server; `chronyc tracking` or `timedatectl` "
        "shows the state. In a container, do this on the host."
    )
    if leaving:
        return _CLOCK.failing(f"{found}, which {' and '.join(leaving)} can reach", remedy)
    return _CLOCK.warning(f"{found}; so far, all messages stay on this computer", remedy)
