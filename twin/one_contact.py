"""One contact, from specifications to a folder: pressed, rendered, and written with its exact ground truth."""

from dataclasses import dataclass
from pathlib import Path

from scenes import ObjectSpec, SensorSpec
from twin.contact_files import write_contact
from twin.mechanics.path import ContactPose
from twin.progress import Progress, silent, stage
from twin.simulator import Shot, Simulator
from twin.types import ContactState, Form


@dataclass(frozen=True)
class RenderedContact:
    """What was made of it."""

    state: ContactState
    shot: Shot
    written: list[Path]

    def lines(self) -> list[str]:
        """Force, contact area and caps in sight, for people."""
        force = self.state.force_n.round(2) + 0.0  # no negative zeros
        visible = self.shot.truth.visible
        return [
            f"force {force[0]:+.2f} {force[1]:+.2f} {force[2]:+.2f} N, contact area {self.state.area_mm2:.1f} mm2, "
            f"{int(visible.sum())} of {len(visible)} caps in sight"
        ]


def render_contact(
    sensor: SensorSpec,
    stimulus: ObjectSpec,
    pose: ContactPose,
    out: Path,
    *,
    form: Form = Form.RAW,
    quality: str = "standard",
    seed: int = 0,
    progress: Progress = silent,
) -> RenderedContact:
    """Press an object against a sensor, render what the camera sees, and write both with their ground truth.

    Parameters
    ----------
    out : Path
        An existing folder.
    form : Form
        The camera's frame, or the form of the sensor's recordings.
    quality : {"preview", "standard", "high"}
        Samples per pixel.
    seed : int
        Of the renderer and of the camera's noise.

    Raises
    ------
    FrameError
        The sensor has no recordings' form.
    ContactError
        The pose is out of reach, or the solver does not converge.
    RenderError
        Nothing can be rendered here.
    """
    simulator = Simulator(sensor, quality=quality)
    simulator.check_form(form)
    with stage(progress, f"press {stimulus.name}") as step:
        state = simulator.press(stimulus, pose, progress=step)
    with stage(progress, "render"):
        shot = simulator.shoot(state, form=form, seed=seed)
    with stage(progress, "pictures"):
        written = write_contact(out, simulator, stimulus, pose, state, shot)
    return RenderedContact(state, shot, written)
