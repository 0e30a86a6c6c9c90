"""Films: figures that change, as GIF."""

from collections.abc import Callable
from os import PathLike

from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

RATE = 12  # frames a second


def film(path: str | PathLike, figure: Figure, draw: Callable[[int], None], frames: int) -> None:
    """Write a film as GIF.

    Args:
        path: File to write.
        figure: What is filmed.
        draw: Changes the figure to frame k, for k from 0 to `frames` - 1 in turn.
        frames: How many.
    """
    writer = PillowWriter(fps=RATE)
    with writer.saving(figure, str(path), dpi=figure.dpi):
        for k in range(frames):
            draw(k)
            writer.grab_frame()
