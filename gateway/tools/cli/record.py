"""``rtc3d-gateway record``: write what gateways publish to an LCM event log."""

import os
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from gateway.tools.cli import options
from gateway.tools.cli.run import StopSignals

if TYPE_CHECKING:
    from gateway.client.recorder import TakeRecording
    from gateway.tools.cli.record_progress import RecordProgress

_TICK_S: Final = 0.1


@options.with_options
def record(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="The new file (.lcmlog), or a folder for SOURCE-DATE-TIME.lcmlog. Nothing is overwritten.",
        ),
    ],
    *,
    source: options.SourcesOption = None,
    component: options.ComponentsOption = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            min=0, help="Stop after this many seconds of messages; the default is to record until Ctrl-C."
        ),
    ] = None,
    details: options.DetailsOptions,
    lcm: options.LcmOption = False,
    where: options.AddressOptions,
    quiet: options.NoProgressOption = False,
) -> None:
    """Record what gateways publish, until Ctrl-C. The exit status is 0 only if no message is missing.

    A second Ctrl-C ends at once, without what waits for the disk.
    """
    where.check(lcm=lcm)
    described = details.checked()
    from gateway.client.client import GatewayClient
    from gateway.client.lcm_transport import START_S
    from gateway.client.recorder import FileWriter, TakeRecording, Target
    from gateway.client.transport import close_in_time
    from gateway.tools.cli.record_output import print_summary
    from gateway.tools.cli.record_progress import RecordProgress

    def end_at_once(signal_number: int) -> None:
        if sys.stderr.isatty():
            os.write(2, b"\x1b[?25h\n")  # the progress line has hidden the cursor
        os._exit(128 + signal_number)

    stop = StopSignals(end_at_once)
    target = Target(file)
    recording = TakeRecording(
        lambda sources: FileWriter(target.open(sources)), component, START_S if lcm else 0.0, described
    )
    sources = list(dict.fromkeys(source or ()))
    try:
        subscriber = GatewayClient(where.address(lcm=lcm)).subscribe(
            sources, component, recording, complete=True
        )
        progress = RecordProgress(recording, subscriber, sources, quiet=quiet)
        start_s = time.monotonic()
        try:
            while not stop.wait(_TICK_S):
                subscriber.tick()
                recording.tick()
                progress.tick()
                # The seconds begin with the first message, or at once while there is none.
                first_s = recording.first_heard_s or start_s
                if seconds is not None and time.monotonic() - first_s >= seconds:
                    break
            _refill(recording, progress)
            # Write everything that has arrived. A disk that is full loses it; for a slow one, wait.
            recording.stop()
            if recording.file is not None:
                recording.file.give_up()
            while not recording.close(_TICK_S):
                progress.tick()
        finally:
            progress.close()
            close_in_time(subscriber)
        is_complete = print_summary(recording, sys.stdout)
    finally:
        target.discard_empty()
    if not is_complete:
        raise typer.Exit(1)


def _refill(recording: "TakeRecording", progress: "RecordProgress") -> None:
    """Request what is missing until now."""
    if (refill := recording.refill) is not None:
        refill.end()
        refill.wait_for_end(_TICK_S, progress.tick)
        time.sleep(_TICK_S)  # an answer can overtake the parameters that describe its messages
        refill.close()
