"""Animations: figures that change, written as GIF."""

from collections.abc import Callable
from os import PathLike

from matplotlib.animation import PillowWriter
from matplotlib.figure import Figure

FRAMES_PER_SECOND = 12  # [frames per second]


def write_gif(
    path: str | PathLike, figure: Figure, draw: Callable[[int], None], frames: int
) -> None:
    """Write an animation of a figure as GIF.

    Args:
        path: File to write.
        figure: The figure.
        draw: Draws frame k on the figure; called for k = 0 .. `frames` - 1 in order.
        frames: Number of frames.
    """
    writer = PillowWriter(fps=FRAMES_PER_SECOND)
    with writer.saving(figure, str(path), dpi=figure.dpi):
        for frame in range(frames):
            draw(frame)
            writer.grab_frame()
