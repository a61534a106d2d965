"""A clock that stands still while this process is stalled.

A long call that holds the interpreter's lock, or a busy machine, stops all threads of this program. A device that answered meanwhile must
not count as silent. Therefore its silence is measured with ``awake_s``. A thread looks at the time every ``TICK_S``; what a tick takes in
addition to ``LONGEST_S`` is a stall and does not count.
"""

import threading
import time

# Interval, s, of the ticks, and longest time between two ticks that counts.
TICK_S, LONGEST_S = 0.02, 0.1


class AwakeClock:
    """Counts the seconds in which this process was not stalled. Its thread starts at the first call, and again after a fork."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None
        self._stalled_s, self._ticked_s = 0.0, time.monotonic()

    def __call__(self) -> float:
        with self._lock:
            now_s = time.monotonic()
            if self._thread is None or not self._thread.is_alive():
                self._ticked_s = now_s
                self._thread = threading.Thread(target=self._tick, name="awake clock", daemon=True)
                self._thread.start()
            return now_s - self._stalled_s - max(0.0, now_s - self._ticked_s - LONGEST_S)

    def _tick(self) -> None:
        while True:
            time.sleep(TICK_S)
            with self._lock:
                now_s = time.monotonic()
                self._stalled_s += max(0.0, now_s - self._ticked_s - LONGEST_S)
                self._ticked_s = now_s


awake_s = AwakeClock()
"""Seconds in which this process was not stalled, from an arbitrary zero."""
