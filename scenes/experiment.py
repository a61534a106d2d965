"""Specification of an experiment: the contacts that the robot makes, in the robot's coordinates.

The labels are those of the recordings: ``pose_1..6`` and ``move_1..6`` are x, y, z (mm) and Rx, Ry, Rz (deg) of the tool in the work frame.
For each contact a pose and a move are sampled uniformly from their ranges. The arm goes to ``pose - move + clear``, taps by ``tap``, and
moves by ``move`` (the shear). The frame is taken at ``pose + clear + tap``.
"""

from typing import Annotated, Literal, Self

from pydantic import Field, ValidationError, model_validator

from scenes.base import Name, Section, problem_text

LABELS = tuple(f"{kind}_{axis}" for kind in ("pose", "move") for axis in range(1, 7))

Range = tuple[float, float]
Six = tuple[float, float, float, float, float, float]


class PoseRanges(Section):
    """Lowest and highest value of each coordinate of the pose. If both are equal, the coordinate is fixed.

    Attributes
    ----------
    pose_1, pose_2, pose_3 : (lowest, highest)
        x, y and z of the tool in the work frame, mm.
    pose_4, pose_5, pose_6 : (lowest, highest)
        Rx, Ry and Rz, deg.
    """

    pose_1: Range = (0.0, 0.0)
    pose_2: Range = (0.0, 0.0)
    pose_3: Range = (0.0, 0.0)
    pose_4: Range = (0.0, 0.0)
    pose_5: Range = (0.0, 0.0)
    pose_6: Range = (0.0, 0.0)


class MoveRanges(Section):
    """Lowest and highest value of each coordinate of the move that follows the tap. If both are equal, the coordinate is fixed.

    Attributes
    ----------
    move_1, move_2, move_3 : (lowest, highest)
        Along x, y and z of the work frame, mm.
    move_4, move_5, move_6 : (lowest, highest)
        Rotation about x, y and z, deg.
    """

    move_1: Range = (0.0, 0.0)
    move_2: Range = (0.0, 0.0)
    move_3: Range = (0.0, 0.0)
    move_4: Range = (0.0, 0.0)
    move_5: Range = (0.0, 0.0)
    move_6: Range = (0.0, 0.0)


class WideRanges(Section):
    """What is larger in an experiment's wide form, in which models are trained, so that no label of the experiment lies at an end.

    Attributes
    ----------
    clear, tap : six numbers or None
        As in the experiment; None: the same.
    pose_1, pose_2, pose_3, pose_4, pose_5, pose_6, move_1, move_2, move_3, move_4, move_5, move_6 : (lowest, highest) or None
        Ranges of the pose and of the move; None: the same.
    """

    clear: Six | None = None
    tap: Six | None = None
    pose_1: Range | None = None
    pose_2: Range | None = None
    pose_3: Range | None = None
    pose_4: Range | None = None
    pose_5: Range | None = None
    pose_6: Range | None = None
    move_1: Range | None = None
    move_2: Range | None = None
    move_3: Range | None = None
    move_4: Range | None = None
    move_5: Range | None = None
    move_6: Range | None = None


class ExperimentSpec(Section):
    """The complete specification of an experiment.

    Attributes
    ----------
    name : str
        The file's stem; not a key of the file.
    description : str
        One line for ``twin experiments``.
    source : str
        Source of the ranges.
    object : str
        Default object of the contacts: a name of ``twin objects`` or a file.
    approach : {"x", "y", "z"}
        Axis of the work frame along which the sensor approaches the object. It is "y" for an arm with four axes, which holds the sensor
        horizontally.
    zero_mm : float
        Indentation of an unrotated sensor at ``pose + clear + tap`` if the pose's coordinate along the approach is 0.
    clear, tap : six numbers
        ``clear`` is added to the pose before the tap, and ``tap`` is the motion of the tap; mm and deg.
    tap_frame : {"work", "tool"}
        Axes of the tap: those of the work frame, or those of the tool, which is rotated by the pose. With "tool" a rotated sensor
        approaches along its own axis, and slides on the object's surface.
    targets : tuple of str
        The labels that a model learns.
    seed : int
        Seed of the random draws.
    wider : str
        Name of another experiment, with which models for this one are trained in the twin.
    wide : WideRanges or None
        Instead of ``wider``: slightly larger ranges, with which models for this experiment are trained in the twin.
    pose : PoseRanges
        Ranges of the contacts' poses.
    move : MoveRanges
        Ranges of the move (the shear) after the tap; no move by default.
    """

    name: Name
    description: str
    source: str = ""
    object: str
    approach: Literal["x", "y", "z"]
    zero_mm: float
    clear: Six = (0.0,) * 6
    tap: Six
    tap_frame: Literal["work", "tool"] = "work"
    targets: Annotated[tuple[str, ...], Field(min_length=1)]
    seed: Annotated[int, Field(ge=0)] = 0
    wider: str = ""
    wide: WideRanges | None = None
    pose: PoseRanges
    move: MoveRanges = MoveRanges()

    @property
    def axis(self) -> int:
        """Index of the approach's coordinate in a pose."""
        return "xyz".index(self.approach)

    def ranges(self) -> dict[str, Range]:
        """Range of each of the twelve labels, in the recordings' order."""
        return {**self.pose.model_dump(), **self.move.model_dump()}

    @property
    def highest_mm(self) -> float:
        """Largest coordinate along the approach before the move, mm. The tap is deepest at this coordinate."""
        return self.ranges()[f"pose_{self.axis + 1}"][1] - self.ranges()[f"move_{self.axis + 1}"][0]

    def widen(self) -> "ExperimentSpec":
        """The experiment in its wide form; itself if it has none."""
        if self.wide is None:
            return self
        larger = self.wide.model_dump(exclude_none=True)
        parts = {key: getattr(self, key).model_dump() for key in ("pose", "move")}
        parts = {key: part | {label: larger.pop(label) for label in part if label in larger} for key, part in parts.items()}
        text = f"As {self.name}, a little beyond its ranges"
        return ExperimentSpec(**{**dict(self), **larger, **parts, "name": f"{self.name}-wide", "description": text, "wide": None})

    @model_validator(mode="after")
    def _check(self) -> Self:
        for label, (low, high) in self.ranges().items():
            if low > high:
                raise ValueError(f"{label} = [{low:g}, {high:g}]: give the lower end first")
        if unknown := [label for label in self.targets if label not in LABELS]:
            raise ValueError(f"targets: {', '.join(unknown)} is no label; choose of {', '.join(LABELS)}")
        if any(self.tap[k] for k in range(6) if k != self.axis):
            raise ValueError(f"tap must go along the approach, {self.approach}, alone")
        if self.tap[self.axis] <= 0:
            raise ValueError(f"tap must go towards the object: its {self.approach} is {self.tap[self.axis]:g}, expected more than 0")
        start_mm = self.zero_mm + self.highest_mm - self.tap[self.axis]
        if start_mm > 0:
            raise ValueError(f"the deepest tap would begin {start_mm:g} mm inside the object; give a longer tap and as much more clear")
        try:
            self.widen()
        except ValidationError as error:
            raise ValueError(f"wide: {problem_text(error.errors()[0])}") from error
        return self
