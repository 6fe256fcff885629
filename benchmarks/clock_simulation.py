"""The accuracy of the server clock's model: the table and the plot of docs/explanation/clocks.md.

Run it in the repository, with matplotlib installed: python -m benchmarks.clock_simulation
It prints the table and writes the plot. All frames are simulated with fixed seeds; nothing sleeps.
"""

import time
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from gateway.session.clock import ServerClock
from tests.support.clock_simulation import Frames, Numbers, Observed, observe, percentile_95_us, simulate

PLOT: Final = Path(__file__).parent.parent / "docs" / "explanation" / "clocks.png"
SEEDS: Final = 50
LEARNING_S: Final = 30
COLOURS: Final = {100: "#1f6fb4", -100: "#d1702a"}


def changing_drift(host_s: Numbers) -> Numbers:
    """Return a drift in ppm that varies between -100 and 100 with a period of ten minutes."""
    return np.asarray(100 * np.sin(2 * np.pi * host_s / 600))


NETWORKS: Final[list[tuple[str, dict[str, Any]]]] = [
    ("200 Hz, drift 100 ppm, jitter 5 ms", {"rate_hz": 200, "drift_ppm": 100}),
    ("200 Hz, drift −100 ppm, jitter 5 ms", {"rate_hz": 200, "drift_ppm": -100}),
    ("the same, 2 % of frames 200 ms later", {"rate_hz": 200, "drift_ppm": -100, "outliers": 0.02}),
    ("30 Hz, drift 100 ppm, jitter 5 ms", {"rate_hz": 30, "drift_ppm": 100}),
    ("1000 Hz, drift 100 ppm, jitter 1 ms", {"rate_hz": 1000, "drift_ppm": 100, "jitter_us": 1_000}),
    ("1000 Hz, drift 100 ppm, jitter 5 ms", {"rate_hz": 1000, "drift_ppm": 100}),
]


def frames_with_drift(drift_ppm: float, seed: int) -> Frames:
    """Return the frames of one minute, as in the plot."""
    return simulate(seconds=60, rate_hz=200, drift_ppm=drift_ppm, seed=seed)


def print_table() -> None:
    """Print the errors of each network after 30 s: 95th percentiles over seeds, and the largest error."""
    print(
        "| frames | error of 95 % of the frames, median of the runs | the same, worst run "
        "| greatest error of any frame |"
    )
    print("|---|---:|---:|---:|")
    for name, network in NETWORKS:
        print_row(name, [simulate(seconds=60, seed=seed, **network) for seed in range(SEEDS)])
    slow: dict[str, Any] = {"seconds": 600, "rate_hz": 200, "drift_ppm": changing_drift}
    print_row(
        "200 Hz, drift changing by ±100 ppm in 10 min", [simulate(seed=seed, **slow) for seed in range(10)]
    )


def print_row(name: str, runs: list[Frames]) -> None:
    """Print one row of the table."""
    errors = [late_errors_us(frames) for frames in runs]
    percentiles = [percentile_95_us(errors_us) for errors_us in errors]
    largest_us = max(np.abs(errors_us).max() for errors_us in errors)
    print(f"| {name} | {whole(np.median(percentiles))} | {whole(max(percentiles))} | {whole(largest_us)} |")


def late_errors_us(frames: Frames) -> Any:
    """Return the errors of a new clock from LEARNING_S on."""
    since_us = frames.captured_utime - frames.captured_utime[0]
    return observe(ServerClock(), frames).errors_us[since_us >= LEARNING_S * 1_000_000]


def whole(time_us: Any) -> str:
    """Return a time as text, rounded to µs."""
    return f"{round(time_us)} µs"


def print_speed() -> None:
    """Print the time that ServerClock.observe takes per frame."""
    frames = simulate(seconds=60, rate_hz=2000, jitter_us=1_000)
    stamps, arrivals = frames.timestamps_us.tolist(), frames.arrivals_utime.tolist()
    clock = ServerClock()
    began_s = time.perf_counter()
    for number, (timestamp_us, arrival_utime) in enumerate(zip(stamps, arrivals, strict=True)):
        clock.observe(timestamp_us, number, arrival_utime)
    print(f"\n{(time.perf_counter() - began_s) / len(stamps) * 1e6:.2f} µs per frame at 2000 Hz")


def draw() -> None:
    """Plot the errors of utime and of capture_utime over one minute, for both drifts."""
    mpl.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    figure = Figure(figsize=(9, 6.2), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=[1, 1.6])
    runs: dict[int, tuple[Frames, Observed]] = {}
    for seed, drift_ppm in enumerate(COLOURS):
        frames = frames_with_drift(drift_ppm, seed)
        runs[drift_ppm] = frames, observe(ServerClock(), frames)

    frames, observed = runs[100]
    host_s = (frames.captured_utime - frames.captured_utime[0]) / 1e6
    utime_errors_ms = (frames.arrivals_utime - frames.captured_utime) / 1000
    above.plot(
        host_s, utime_errors_ms, ".", markersize=1.5, color="0.6", label="utime: when the frame arrived"
    )
    above.plot(host_s, observed.errors_us / 1000, color=COLOURS[100], linewidth=1.2, label="capture_utime")
    above.set(ylabel="error (ms)", title="Error of a frame's time: 200 Hz, exponential jitter of 5 ms mean")
    above.legend(loc="upper right", markerscale=5, framealpha=1)

    below.axhspan(-0.5, 0.5, color="0.93", zorder=0)
    below.text(59.8, 0.47, "0.5 ms, required after 30 s", ha="right", va="top", color="0.35")
    for drift_ppm, (_, observed) in runs.items():
        label = f"capture_utime, drift {drift_ppm:+d} ppm".replace("-", "−")
        below.plot(host_s, observed.errors_us / 1000, color=COLOURS[drift_ppm], linewidth=1.2, label=label)
    for since_s, height_ms, text in (
        (1.5, -0.93, "1.5 s: clock known"),
        (5.6, -0.75, "5.6 s: drift known"),
    ):
        below.axvline(since_s, color="0.5", linestyle=":", linewidth=1)
        below.text(since_s + 0.4, height_ms, text, color="0.35", backgroundcolor="white")
    below.set(xlabel="time since the first frame (s)", ylabel="error (ms)", xlim=(0, 60), ylim=(-1, 1))
    below.legend(loc="upper right", ncols=2, framealpha=1)
    PLOT.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PLOT, dpi=130)


if __name__ == "__main__":
    print_table()
    print_speed()
    draw()
