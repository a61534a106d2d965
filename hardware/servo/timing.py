"""Figures of a loop's rate and latency."""

from dataclasses import dataclass, field

import numpy as np

# Percentiles that are reported, in %.
LEVELS = (50, 95, 99)


@dataclass(frozen=True)
class TimeSpread:
    """Percentiles of times, in s; NaN if there are no times."""

    p50: float
    p95: float
    p99: float

    @classmethod
    def of(cls, times_s: list[float]) -> "TimeSpread":
        """The spread of measured times."""
        return cls(*np.percentile(times_s, LEVELS).tolist()) if times_s else cls(*[float("nan")] * 3)

    def __str__(self) -> str:
        return " / ".join(f"{1e3 * value:.1f}" for value in (self.p50, self.p95, self.p99)) + " ms (50 / 95 / 99 %)"


@dataclass(frozen=True)
class Timing:
    """Measurements of a loop.

    Attributes
    ----------
    steps : int
    rate_hz : float
        Steps per second.
    fresh_hz : float
        Steps per second on a frame that was not used before.
    latency_s : TimeSpread
        Time from a fresh frame's exposure to the command that it led to.
    age_s : TimeSpread
        Age of the frame behind each decision at the time of the decision.
    compute_s : TimeSpread
        Time from receiving the frame to the command.
    dropped : int
        Number of frames that nobody read.
    decided_hz : float
        Decisions per second: to move (a step), to wait for the arm or the camera, or to hold still. NaN if the loop makes no decisions.
    decided : dict of str to int
        Number of decisions of each kind.
    notes : list of str
        Irregularities of the camera's frames, one line each.
    """

    steps: int
    rate_hz: float
    fresh_hz: float
    latency_s: TimeSpread
    age_s: TimeSpread
    compute_s: TimeSpread
    dropped: int
    decided_hz: float = float("nan")
    decided: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def lines(self) -> list[str]:
        """The figures as lines of text.

        A loop that makes no decisions gives poses instead of commands. Frames of a recording have no age, so it is left out.
        """
        total = sum(self.decided.values())
        decided = [f"decisions at {self.decided_hz:.1f} Hz: " + ", ".join(f"{n / total:.0%} {what}" for what, n in self.decided.items())]
        made = "command" if total else "pose"
        taken = "at each decision" if total else "when it was taken"
        spreads = {f"exposure to {made}": self.latency_s, f"age of the frame {taken}": self.age_s, f"frame to {made}": self.compute_s}
        return [
            *(f"note: {note}" for note in self.notes),
            *(decided if total else []),
            f"{self.steps} steps at {self.rate_hz:.1f} Hz, fresh frames at {self.fresh_hz:.1f} Hz, dropped frames: {self.dropped}",
            *(f"{what}: {spread}" for what, spread in spreads.items() if np.isfinite(spread.p50)),
        ]
