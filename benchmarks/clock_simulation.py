"""How exact the server's clock is known: the table and the picture of docs/explanation/clocks.md.

Run from the project's folder, with matplotlib installed: python -m benchmarks.clock_simulation
It prints the table and writes the picture. Everything is simulated, with seeds; nothing sleeps.
"""

import time
from pathlib import Path
from typing import Any, Final

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from gateway.stream.clock import ServerClock
from tests.clock_simulation import Frames, Numbers, Observed, observe, percentile_95_us, simulate

PICTURE: Final = Path(__file__).parent.parent / "docs" / "explanation" / "clocks.png"
SEEDS: Final = 50
LEARNED_S: Final = 30
COLOURS: Final = {100: "#1f6fb4", -100: "#d1702a"}


def changing_drift(host_s: Numbers) -> Numbers:
    """Return a drift in ppm that goes from -100 to 100 and back in ten minutes."""
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
    """Return a minute of frames as the picture has them."""
    return simulate(seconds=60, rate_hz=200, drift_ppm=drift_ppm, seed=seed)


def print_table() -> None:
    """Print, of each network, the errors from 30 s to 60 s: the 95th percentiles of seeds, and the worst."""
    print("| frames | 95 % are within: median of seeds | worst seed | greatest error |")
    print("|---|---:|---:|---:|")
    for name, network in NETWORKS:
        print_row(name, [simulate(seconds=60, seed=seed, **network) for seed in range(SEEDS)])
    slow: dict[str, Any] = {"seconds": 600, "rate_hz": 200, "drift_ppm": changing_drift}
    print_row(
        "200 Hz, drift changing by ±100 ppm in 10 min", [simulate(seed=seed, **slow) for seed in range(10)]
    )


def print_row(name: str, runs: list[Frames]) -> None:
    """Print one row of the table."""
    learned = [late_errors_us(frames) for frames in runs]
    percentiles = [percentile_95_us(errors_us) for errors_us in learned]
    greatest_us = max(np.abs(errors_us).max() for errors_us in learned)
    print(f"| {name} | {whole(np.median(percentiles))} | {whole(max(percentiles))} | {whole(greatest_us)} |")


def late_errors_us(frames: Frames) -> Any:
    """Return the errors of a new clock from LEARNED_S on."""
    since_us = frames.captured_utime - frames.captured_utime[0]
    return observe(ServerClock(), frames).errors_us[since_us >= LEARNED_S * 1_000_000]


def whole(time_us: Any) -> str:
    """Return a time as the table has it."""
    return f"{round(time_us)} µs"


def print_speed() -> None:
    """Print what one frame costs."""
    frames = simulate(seconds=60, rate_hz=2000, jitter_us=1_000)
    stamps, arrivals = frames.timestamps_us.tolist(), frames.arrivals_utime.tolist()
    clock = ServerClock()
    began_s = time.perf_counter()
    for number, (timestamp_us, arrival_utime) in enumerate(zip(stamps, arrivals, strict=True)):
        clock.observe(timestamp_us, number, arrival_utime)
    print(f"\n{(time.perf_counter() - began_s) / len(stamps) * 1e6:.2f} µs per frame at 2000 Hz")


def draw() -> None:
    """Write the picture: the error of utime and of capture_utime over a minute, for both drifts."""
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
    above.plot(host_s, utime_errors_ms, ".", markersize=1.5, color="0.6", label="utime: when the frame came")
    above.plot(host_s, observed.errors_us / 1000, color=COLOURS[100], linewidth=1.2, label="capture_utime")
    above.set(ylabel="error (ms)", title="Error of a frame's time: 200 Hz, exponential jitter of 5 ms mean")
    above.legend(loc="upper right", markerscale=5, framealpha=1)

    below.axhspan(-0.5, 0.5, color="0.93", zorder=0)
    below.text(59.8, 0.47, "0.5 ms, required after 30 s", ha="right", va="top", color="0.35")
    for drift_ppm, (_, observed) in runs.items():
        label = f"capture_utime, drift {drift_ppm:+d} ppm".replace("-", "−")
        below.plot(host_s, observed.errors_us / 1000, color=COLOURS[drift_ppm], linewidth=1.2, label=label)
    for since_s, height_ms, text in (
        (1.5, -0.93, "1.5 s: there is a clock"),
        (5.6, -0.75, "5.6 s: and its drift"),
    ):
        below.axvline(since_s, color="0.5", linestyle=":", linewidth=1)
        below.text(since_s + 0.4, height_ms, text, color="0.35", backgroundcolor="white")
    below.set(xlabel="time since the first frame (s)", ylabel="error (ms)", xlim=(0, 60), ylim=(-1, 1))
    below.legend(loc="upper right", ncols=2, framealpha=1)
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(PICTURE, dpi=130)


if __name__ == "__main__":
    print_table()
    print_speed()
    draw()
