"""``run_studio``: serves the page of a plan until it is ended."""

import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from twin.studio.modes.degrade_mode import DegradeMode
from twin.studio.modes.mode import PageMode
from twin.studio.modes.new_mode import NewMode
from twin.studio.modes.recording_mode import RecordingMode
from twin.studio.modes.twin_mode import ModelOf, TwinMode
from twin.studio.page import LOCAL, StudioPage
from twin.studio.state import StudioState, heading

PORT = 8090
"""Port of the page."""
LIVE = "Live"
"""Title of the mode that shows a camera and an arm. It is handed in, because this package does not depend on the devices."""
LOOK_S = 0.2
"""Interval, s, at which the end condition is checked."""


@dataclass(frozen=True)
class StudioPlan:
    """The studio's state at the start, and the address on which it listens.

    Attributes
    ----------
    state : StudioState
    out : Path
        Folder for saved files; made when it is needed.
    host, port : str, int
    traces : bool
        Whether pictures are path-traced when the object stands still.
    recording : str
        Recording that the mode 'Recording' opens first.
    camera, arm : str
        Camera and arm that the mode 'Live' connects first.
    seconds : float or None
        Time, s, after which the studio ends.
    """

    state: StudioState
    out: Path
    host: str = "127.0.0.1"
    port: int = PORT
    traces: bool = True
    recording: str = ""
    camera: str = ""
    arm: str = ""
    seconds: float | None = None

    @property
    def warnings(self) -> list[str]:
        """Warnings about the host; none for this machine."""
        if self.host in LOCAL:
            return []
        return [
            f"warning: the page listens on {self.host}. Everyone who reaches this address can use it, move an armed arm and write to "
            f"{self.out}; there is no password. Give no `host` to serve this machine alone"
        ]


ModeMaker = Callable[[StudioPage, TwinMode, StudioPlan], PageMode]


class Studio(ExitStack):
    """The page with its modes. A context manager, which closes all at its end, even if one fails, so that an arm is always released.

    Parameters
    ----------
    plan : StudioPlan
    model_of : callable
        Function from a sensor's name to a trained model, or None.
    live_mode : callable
        Makes the mode 'Live' from the page, the mode 'Twin' and the plan.
    """

    def __init__(self, plan: StudioPlan, model_of: ModelOf, live_mode: ModeMaker) -> None:
        super().__init__()
        titles = [TwinMode.title, DegradeMode.title, RecordingMode.title, LIVE, NewMode.title]
        self.page = StudioPage(heading(plan.state), host=plan.host, port=plan.port, modes=titles, saves=plan.out)
        self.twin = TwinMode(self.page, plan.state, plan.out, model_of, traces=plan.traces)
        degrade = DegradeMode(self.page, self.twin)
        live = live_mode(self.page, self.twin, plan)
        recording, new = RecordingMode(self.page, self.twin, plan.recording), NewMode(self.page, self.twin, plan.out)
        self.twin.followers += [degrade.follow, recording.follow]
        self.modes: list[PageMode] = [self.twin, degrade, recording, live, new]
        self.page.set_modes(self.modes)

    def __enter__(self) -> Self:
        self.enter_context(self.page)
        for mode in self.modes:
            self.callback(mode.stop)
            mode.start()
        return self


def run_studio(plan: StudioPlan, model_of: ModelOf, live_mode: ModeMaker, *, on_open: Callable[[str], None] = lambda url: None) -> None:
    """Serve the studio until Ctrl-C, or for the plan's time.

    Parameters
    ----------
    plan, model_of, live_mode
        As for ``Studio``.
    on_open : callable
        Called with the page's address once it can be opened.

    Raises
    ------
    TwinError
        The server can't listen on the plan's host and port.
    """
    with Studio(plan, model_of, live_mode) as studio:
        on_open(studio.page.url)
        begun = time.monotonic()
        try:
            while plan.seconds is None or time.monotonic() - begun < plan.seconds:
                time.sleep(LOOK_S)
        except KeyboardInterrupt:
            return
