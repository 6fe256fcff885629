"""Export to C3D: markers, analog channels, force plates and events, one file per measurement."""

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import numpy as np

from gateway.errors import TakeError
from gateway.export.c3d_content import C3dContent, content_of
from gateway.export.c3d_format import BLOCK_BYTES, MAX_FRAMES, MAX_WORD, Shape, rate_in_float32
from gateway.export.c3d_groups import encode_head_that_fits
from gateway.export.c3d_points import encode_points, residual_step
from gateway.export.job import ExportJob
from gateway.export.measurements import named_measurements
from gateway.export.take_time import utc_text

_KEYS: Final = ("3d", "analog", "force")
"""The components that can be in a file; the first one that a source has gives the rate of the frames."""

_BLOCK_VALUES: Final = 2_000_000  # values in memory at once: 8 MB


def export_c3d(job: ExportJob) -> None:
    """Write each measurement of each source to a file of its own."""
    for measurement, path in named_measurements(job, _KEYS, "markers, analog channels or forces"):
        _write(job, content_of(job, measurement), path)
        if measurement.source.tools is not None:
            job.note("tools (6D) were left out: a C3D file has points, analog channels and events")


def _write(job: ExportJob, content: C3dContent, path: Path) -> None:
    """Write one file."""
    shape = _shape(content, path)
    if content.markers is not None:
        job.progress(f"reading the residuals of {path.name}", 0, 0)
        step = residual_step(content.points(start, stop) for start, stop in _blocks(shape))
        shape = shape._replace(scale=step)
    file = job.files.create(path)
    file.write(encode_head_that_fits(job, content, shape))
    incomplete_samples = 0
    for start, stop in _blocks(shape):
        points = encode_points(content.points(start, stop), shape.scale).reshape(stop - start, -1)
        channels = content.channels(start, stop)
        incomplete_samples += int(np.isnan(channels).any(axis=1).sum())
        frames = np.concatenate([points, channels.reshape(stop - start, -1)], axis=1)
        file.write(frames.astype("<f4").tobytes())
        job.progress(f"writing {path.name}", stop, content.num_frames)
    if content.num_frames <= MAX_WORD:  # ezc3d reads longer files to their end
        file.write(bytes(-file.tell() % BLOCK_BYTES))
    missing = content.measurement.frames.num_missing(
        content.first_row, content.first_row + content.num_frames
    )
    if missing:
        job.note(
            f"{path.name}: {missing} of {content.num_frames} frames are missing in the take; they are empty"
        )
    start_s = content.start_s
    if start_s * shape.rate_hz >= 1:
        begin = utc_text(content.measurement, start_s)
        job.note(
            f"{path.name}: time 0 is its first frame, {start_s:.3f} s after the take's beginning ({begin})"
        )
    if incomplete_samples:
        job.note(f"{path.name}: {incomplete_samples} analog samples are missing in the take; they are NaN")


def _shape(content: C3dContent, path: Path) -> Shape:
    """Return the sizes of a file. Raises TakeError if C3D cannot have them."""
    samples = content.samples_per_frame
    if content.num_frames > MAX_FRAMES:
        raise TakeError(
            f"{path.name} would have {content.num_frames} frames, but a C3D file has at most {MAX_FRAMES}; "
            "choose a part by --from and --to"
        )
    if content.num_channels * samples > MAX_WORD or content.num_points > MAX_WORD:
        raise TakeError(
            f"{path.name} would have {content.num_points} markers and {content.num_channels} analog "
            f"channels with {samples} samples in each frame, more than a C3D file can have; export to .csv"
        )
    rate_hz = rate_in_float32(content.measurement.grid.rate_hz, samples)
    return Shape(content.num_points, content.num_channels, samples, content.num_frames, rate_hz, 1.0)


def _blocks(shape: Shape) -> Iterator[tuple[int, int]]:
    """Yield the first frame of each block, and the one after its last."""
    values = 4 * shape.num_points + shape.num_channels * shape.samples_per_frame
    size = max(1, _BLOCK_VALUES // max(values, 1))
    for start in range(0, shape.num_frames, size):
        yield start, min(start + size, shape.num_frames)
