"""How trainings tell how far they are, in the terms of ``twin.progress``."""

from collections.abc import Callable, Mapping

from twin.progress import Step


def epoch_step(step: Step) -> Callable[[int, int, Mapping[str, float]], None]:
    """What ``train_run`` calls with (epochs done, epochs in all, the curve's last row): the error on held-out rows becomes the note."""

    def told(done: int, total: int, point: Mapping[str, float]) -> None:
        step(done, total, f"{point['held_out_error']:.4f}")

    return told
