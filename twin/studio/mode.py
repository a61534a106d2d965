"""Base of the page's modes: a folder of controls, threads, and whether the mode shows its pictures."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any, ClassVar, TypeVar

from twin.studio.page import CELLS, Page
from twin.studio.worker import Newest
from twin.types import ImageArray

T = TypeVar("T")


class PageMode(ABC):
    """One of the page's modes. It works in threads of its own, and shows something only while it is the one that the user has chosen.

    Parameters
    ----------
    page : Page

    Attributes
    ----------
    title : str
        By which the user chooses it.
    folder : viser.GuiFolderHandle
        Its controls, seen only while it is chosen.
    """

    title: ClassVar[str]

    def __init__(self, page: Page) -> None:
        self._page, self._active = page, False
        self.folder = page.gui.add_folder(self.title, visible=False)
        self._threads: list[Newest[Any]] = []

    def newest(self, take: Callable[[T], None], name: str) -> Newest[T]:
        """A thread ``studio-NAME`` that begins and ends with the mode; what ``take`` finds wrong is said on the page."""
        thread = Newest(take, f"studio-{name}", self.complain)
        self._threads.append(thread)
        return thread

    def start(self) -> None:
        """Begin to work."""
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        """End threads, processes and connections."""
        for thread in self._threads:
            thread.stop()

    def enter(self) -> None:
        """The user has chosen the mode: the pictures are its own from now on."""
        self._active = True
        self.show()

    def leave(self) -> None:
        """The user has chosen another mode. What is going on goes on, unseen."""
        self._active = False

    @abstractmethod
    def show(self) -> None:
        """Show what there is."""

    def complain(self, text: str) -> None:
        """Say what is wrong."""
        self._page.say(text, bad=True)

    def put_up(
        self,
        pictures: tuple[ImageArray, ImageArray],
        label: str,
        numbers: list[str],
        *,
        below: str = CELLS,
        also: Callable[[], None] = lambda: None,
    ) -> None:
        """Show two pictures (h, w, 3) RGB and numbers, and do ``also``, if the mode is still chosen. Browsers get all of it together."""

        def change() -> None:
            if self._active:
                self._page.show_pictures(*pictures, label, below)
                self._page.show_numbers(*numbers)
                also()

        self._page.together(change)
