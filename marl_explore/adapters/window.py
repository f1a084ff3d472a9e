"""Pictures of an episode in progress, for people: in a window, or as text where there is none."""

from __future__ import annotations

from typing import Any

from marl_explore.envs.pictures import Team, ascii_picture, rgb_picture


class Window:
    """A window of matplotlib; without a display every picture is printed as text.

    Args:
        title: of the window.
        fps: pictures per second that are shown.
    """

    def __init__(self, title: str, fps: float) -> None:
        self.title = title
        self.fps = fps
        self._opened = False
        self._figure: Any = None
        self._image: Any = None

    def show(self, team: Team) -> None:
        """Show the union of a team's maps, its robots and the people around it."""
        if not self._opened:
            self._open(rgb_picture(team))
        if self._figure is None:
            print(ascii_picture(team), end="\n\n", flush=True)
            return
        import matplotlib.pyplot as plt

        if plt.fignum_exists(self._figure.number):  # else somebody has closed it
            self._image.set_data(rgb_picture(team))
            self._figure.canvas.draw_idle()
            plt.pause(1 / self.fps)

    def _open(self, picture: Any) -> None:
        """Open a window, if matplotlib can."""
        import matplotlib.pyplot as plt

        self._opened = True
        try:
            figure = plt.figure(self.title)
        except ImportError:  # a backend was chosen that needs a display
            return
        if figure.canvas.required_interactive_framework is None:  # it draws into files
            plt.close(figure)
            return
        axes = figure.add_axes((0, 0, 1, 1))
        axes.set_axis_off()
        self._figure, self._image = figure, axes.imshow(picture)

    def close(self) -> None:
        """Close the window; the next picture opens another one."""
        if self._figure is not None:
            import matplotlib.pyplot as plt

            plt.close(self._figure)
        self._opened, self._figure, self._image = False, None, None
