"""The style of the plots in the documents."""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS: Final = ("#1f6fb4", "#d1702a", "#3c8d40", "#8a5aa8")


def new_figure(panels: int = 1) -> "tuple[Figure, list[Axes]]":
    """Return a figure and its axes, side by side with one scale of y."""
    import matplotlib as mpl  # noqa: PLC0415 - not needed by the tests
    from matplotlib.figure import Figure  # noqa: PLC0415 - as above

    mpl.rcParams.update(
        {
            "font.size": 10,
            "axes.spines.top": False,
            "axes.spines.right": False,
            "svg.fonttype": "none",
            "svg.hashsalt": "rtc3d",  # the same figures give the same file
        }
    )
    figure = Figure(figsize=(8, 4.2), layout="constrained")
    return figure, list(figure.subplots(1, panels, sharey=True, squeeze=False)[0])


def label_subscribers(axes: "Axes", counts: Collection[int]) -> None:
    """Label the axis of x, the number of subscribers; y begins at 0."""
    axes.set_xscale("log", base=2)
    ticks = sorted(set(counts))
    axes.set_xticks(ticks, [str(tick) for tick in ticks])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_xlabel("subscribers")
    axes.grid(axis="y", color="0.9")


def save(figure: "Figure", file: Path) -> None:
    """Write the plot to the file of the document."""
    metadata = {"Date": None} if file.suffix == ".svg" else None
    figure.savefig(file, dpi=130, metadata=metadata)
