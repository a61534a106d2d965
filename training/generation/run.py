"""Generation of a simulated data set in this process, in several processes, or on a cluster."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scenes import ExperimentSpec, ObjectSpec, RandomisationSpec, SensorSpec, load_object
from training.generation.config import GenerationConfig, Images, States, require_count
from training.generation.make import REST, make_contact
from training.generation.store import CONFIG, FILES, Store, refuse_foreign
from twin.errors import OptionError, format_count
from twin.frames.forms import frame_size
from twin.progress import Progress, Step, silent, stage, unheard
from twin.records import KeptAlso
from twin.rig.contact import friction_between
from twin.store import output
from twin.store.resume import MADE_BY
from twin.types import FINE, Quality, ReadableResult
from twin.workers import outcomes, require_scheduler


@dataclass(frozen=True, repr=False)
class Simulated(ReadableResult):
    """A data set that was made.

    Attributes
    ----------
    folder : Path
    contacts, frames : int
        Number in the whole data set.
    before : int
        Contacts that the folder held before this run.
    failed : int
        Draws that failed in this run.
    """

    folder: Path
    contacts: int
    frames: int
    before: int
    failed: int

    @property
    def written(self) -> list[Path]:
        """The data set's folder."""
        return [self.folder]

    def lines(self) -> list[str]:
        """The result as lines of text."""
        lines = [f"{format_count(self.before, 'contacts')} from before"] if self.before else []
        if self.failed:
            lines.append(f"{format_count(self.failed, 'contacts')} failed and sampled again: see {self.folder / 'failures.csv'}")
        return [*lines, f"{format_count(self.frames, 'frames')} of {format_count(self.contacts, 'contacts')}"]


def generate(
    folder: Path, config: GenerationConfig, count: int, *, workers: int = 1, scheduler: str = "", progress: Step = unheard
) -> Simulated:
    """Make a data set of ``count`` contacts, or continue the one in the folder.

    The result does not depend on ``workers``, on ``scheduler``, or on how often the work was interrupted.

    Parameters
    ----------
    workers : int
        Processes on this machine; with 1 the work is done in this process.
    scheduler : str
        Address of a Dask scheduler whose workers do the work instead.
    progress : callable, optional
        Called with (contacts done, contacts wanted).

    Raises
    ------
    DatasetError
        The folder holds another data set or more contacts than wanted, can't be written to, the workers are lost, or a
        contact can't be made; ``count`` is larger than ``MOST_CONTACTS``; or no scheduler answers.
    RenderError
        The machine can't render.
    StoreError
        Another run uses the folder, or another version of the program made its content.
    """
    require_count(count)
    if scheduler:
        require_scheduler(scheduler)
    refuse_foreign(folder)
    with output(folder, *FILES, gone_on=(CONFIG, MADE_BY)):
        store = Store(folder, config)
        done = store.list_finished()
        before = len(done - {REST})
        store.check_count(count)
        todo = [index for index in range(REST, count) if index not in done]
        made, failed = before, 0
        progress(made, count)
        for outcome in outcomes(make_contact, config.text(), todo, workers=workers, scheduler=scheduler):
            store.add(outcome)
            failed += len(outcome.failures)
            made += outcome.index != REST
            progress(made, count)
        return Simulated(folder, count, store.finish(count), before, failed)


def config_for(
    sensor: SensorSpec,
    experiment: ExperimentSpec,
    *,
    obj: ObjectSpec | None = None,
    images: Images = "raw",
    states: States = "end",
    randomisation: RandomisationSpec | None = None,
    seed: int | None = None,
    quality: Quality | None = None,
    across: int = FINE,
) -> GenerationConfig:
    """The resolved configuration of a data set.

    Parameters
    ----------
    obj : ObjectSpec, optional
        The object; the experiment's own by default. For its friction on this sensor see ``friction_between``.
    seed : int, optional
        Seed of all random numbers; the experiment's own by default.
    quality : {"rasterised", "preview", "standard", "high"}, optional
        By default ``rasterised``, which is nearer to a converged picture than the few samples for which a data set has time.

    Raises
    ------
    FrameError
        The sensor has no frames of the requested form.
    """
    obj = obj or load_object(experiment.object)
    friction = friction_between(sensor.rig and sensor.rig.for_object(obj.name), obj).static
    parts: dict[str, Any] = {"sensor": sensor, "object": obj, "experiment": experiment, "randomisation": randomisation}
    parts |= {"friction": friction, "seed": experiment.seed if seed is None else seed, "images": images, "states": states}
    config = GenerationConfig(**parts, quality=quality or "rasterised", across=across)
    frame_size(sensor, config.form)
    return config


def simulate_dataset(
    config: GenerationConfig,
    out: Path,
    count: int,
    *,
    workers: int = 1,
    scheduler: str = "",
    also: Sequence[str] = (),
    progress: Progress = silent,
) -> Simulated:
    """Make a data set of ``count`` contacts, or continue the one in the folder; other parameters and errors as for ``generate``.

    Parameters
    ----------
    also : sequence of str
        Further formats (``twin.records.ALSO``) in which the finished data set is kept, each in a subfolder.

    Raises
    ------
    OptionError
        A further format is requested for pins without pictures.
    RecordError
        There is no such format, or a library is missing.
    """
    if also and config.images == "none":
        raise OptionError("`also` needs pictures; give `images` raw, gray or processed")
    with KeptAlso(out, also, config.sensor, at_once=False) as kept:
        with stage(progress, f"{config.experiment.name}, {config.sensor.name}") as step:
            made = generate(out, config, count, workers=workers, scheduler=scheduler, progress=step)
        kept.catch_up()
    return made
