"""Base class of the page's modes: it holds the mode's controls and threads, and its pictures are shown only while the mode is chosen."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from twin.studio.page import CELLS, LineChart, StudioPage
from twin.studio.worker import Newest
from twin.types import ImageArray

T = TypeVar("T")
Pictures = tuple[ImageArray, ImageArray]


class PageMode(ABC):
    """One of the page's modes. It works in its own threads, and shows results only while the user has chosen it.

    Parameters
    ----------
    page : Page

    Attributes
    ----------
    title : str
        Name by which the user chooses the mode.
    has_scene : bool
        Whether the scene belongs to the mode. Otherwise it is hidden while the mode is chosen.
    folder : viser.GuiFolderHandle
        The mode's controls, visible only while it is chosen.
    charts : tuple of LineChart
        The mode's charts, visible only while it is chosen.
    """

    title: ClassVar[str]
    has_scene: ClassVar[bool] = False

    def __init__(self, page: StudioPage) -> None:
        self._page, self._active = page, False
        self.folder = page.gui.add_folder(self.title, visible=False)
        self._threads: list[Newest[Any]] = []
        self.charts: tuple[LineChart, ...] = ()

    def newest(self, take: Callable[[T], None], name: str) -> Newest[T]:
        """A thread ``studio-NAME`` that starts and stops with the mode. Errors of ``take`` are shown on the page."""
        thread = Newest(take, f"studio-{name}", self.complain)
        self._threads.append(thread)
        return thread

    def start(self) -> None:
        """Start to work."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End threads, processes and connections."""
        for thread in self._threads:
            thread.stop()

    def enter(self) -> None:
        """The user has chosen the mode. From now on the pictures are those of this mode."""
        self._active = True
        for chart in self.charts:
            chart.show(True)
        self.show()

    def leave(self) -> None:
        """The user has chosen another mode. Work in progress continues, but is not shown."""
        self._active = False
        for chart in self.charts:
            chart.show(False)

    @abstractmethod
    def show(self) -> None:
        """Show the newest results."""

    def complain(self, text: str) -> None:
        """Show an error."""
        self._page.say(text, bad=True)

    def put_up(
        self, pictures: Pictures, label: str, numbers: list[str], *, below: str = CELLS, also: Callable[[], None] = lambda: None
    ) -> None:
        """Show two pictures (h, w, 3) RGB and numbers, and call ``also``, if the mode is still chosen. Browsers get all of it together."""

        def change() -> None:
            if self._active:
                self._page.show_pictures(*pictures, label, below)
                self._page.show_numbers(*numbers)
                also()

        self._page.together(change)
