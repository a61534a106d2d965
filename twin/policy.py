"""A trained policy: a small network that computes a motion of the tool from the pins.

A policy's file contains no code. A policy takes frames through the real pipeline, both on a real arm and in the twin.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from scenes.sensor import SensorSpec
from twin.errors import FrameError, TwinError
from twin.estimate import PinsFound
from twin.pins import Pipeline, Reference, measure_reference, nominal_reference
from twin.store import ArrayFile, Layers, layers_from, layers_to, through_layers
from twin.types import BoolArray, FloatArray, Form, Frame, ImageArray


class PolicyError(TwinError):
    """A policy's file can't be used, or its policy can't be run on frames."""


FILE = ArrayFile("policy", "twin learn", version=1, error=PolicyError)
Displacements = Callable[[FloatArray, BoolArray], tuple[FloatArray, str]]
"""Function from pins (N, 2), px, of which some are lost (N,), to their displacements from rest in mean spacings, and to the reason why no
action may follow from them; "" if it may."""
DOMAIN = "domain."
"""Beginning of the names of a domain's arrays in a policy's file."""
PICTURE_CELL_PX = 4
"""Side of the squares whose means are the inputs from a picture. It is about half the distance between two pins."""


class KnownContacts(Protocol):
    """The contacts that a policy knows (``training.environments.policy_domain``)."""

    def seen_from(self, rest: Reference, name: str) -> Displacements:
        """Displacements from pins at rest in the frame ``name``.

        Raises
        ------
        FrameError
            The camera's view is turned, mirrored or stretched too far.
        """


@dataclass(frozen=True)
class Policy:
    """A policy for one task and one sensor.

    Attributes
    ----------
    about : dict
        Task, sensor, observation, axes, the motion for an action of 1, the task's own feed, the goal, and the training (JSON).
    mean : (D,) float
        Mean of the flattened observations.
    basis : (K, D) float
        Projection of the centred observations to the K inputs of the networks, each with a size of about 1.
    layers : tuple of ((o, i), (o,)) float
        Layers of the network of the actions, with tanh between them. Its inputs are the K numbers, the goal, and the outputs of ``sight``.
    sight : tuple of ((o, i), (o,)) float
        Layers of a network that estimates quantities without a sensor (such as place and force) from the K numbers and the goal; empty
        without such a network.
    domain : dict of str to array
        The contacts that it knows (``training.environments.policy_domain``); empty in policies learnt before version 2, and in those that
        do not see pins.
    """

    about: dict[str, Any]
    mean: FloatArray
    basis: FloatArray
    layers: Layers
    sight: Layers = ()
    domain: Mapping[str, np.ndarray] = field(default_factory=dict)

    def reduce_inputs(self, tactile: FloatArray, goal: FloatArray) -> FloatArray:
        """Inputs (B, K + G + S) of the network of the actions, from observations (B, ...) and goals (B, G)."""
        seen = (flatten(tactile) - self.mean) @ self.basis.T
        x = np.concatenate([seen, goal], axis=1).astype(np.float32)
        return np.concatenate([x, through_layers(self.sight, x, np.tanh)], axis=1) if self.sight else x

    def act(self, tactile: FloatArray, goal: FloatArray) -> FloatArray:
        """Actions (B, A) in [-1, 1]."""
        return np.clip(through_layers(self.layers, self.reduce_inputs(tactile, goal), np.tanh), -1.0, 1.0)

    @property
    def axes(self) -> tuple[str, ...]:
        """Axes of the work frame along and about which the policy moves the tool."""
        return tuple(self.about["axes"])

    def step(self, action: FloatArray) -> FloatArray:
        """The tool's motion (6,) in the work frame for an action (A,), in mm and deg, with the task's feed."""
        step = np.array([*self.about["feed_mm"], 0.0, 0.0, 0.0], float)
        for axis, part, size in zip(self.axes, action, self.about["scale"], strict=True):
            step[("x", "y", "z", "Rx", "Ry", "Rz").index(axis)] += part * size
        return step

    def save(self, path: Path) -> int:
        """Write the policy to a file; returns its size in bytes."""
        arrays = {"mean": self.mean, "basis": self.basis, **layers_to(self.layers), **layers_to(self.sight, "sight")}
        domain = {DOMAIN + key: value for key, value in self.domain.items()}
        return FILE.write(path, {key: value.astype(np.float32) for key, value in arrays.items()} | domain, self.about)


def load_policy(path: Path) -> Policy:
    """Read a policy.

    Raises
    ------
    PolicyError
        If there is no such file, or if it contains no policy of this version.
    """
    with FILE.open_arrays(path) as (about, arrays):
        SensorSpec.model_validate(about["sensor"])
        domain = {key.removeprefix(DOMAIN): arrays.pop(key) for key in list(arrays) if key.startswith(DOMAIN)}
        return Policy(about, arrays["mean"], arrays["basis"], layers_from(arrays), layers_from(arrays, "sight"), domain)


def flatten(tactile: FloatArray | ImageArray) -> FloatArray:
    """Observations (B, ...) as vectors (B, D). Pictures (B, H, W, k) uint8 become means over squares of ``PICTURE_CELL_PX``, 0 to 1."""
    if tactile.dtype != np.uint8:
        return np.asarray(tactile, float).reshape(len(tactile), -1)
    count, height, width, stack = tactile.shape
    cells = (height // PICTURE_CELL_PX, PICTURE_CELL_PX, width // PICTURE_CELL_PX, PICTURE_CELL_PX)
    means: FloatArray = tactile.reshape(count, *cells, stack).mean(axis=(2, 4), dtype=np.float32)
    return means.reshape(count, -1) / 255.0


class PolicyAction(PinsFound):
    """Result of a policy for a frame, for a control loop: an ``Estimate`` whose labels are the axes and whose values are the action.

    An action's numbers are shares of their ranges, without intervals.
    """


class PolicyModel:
    """A policy with its sensor and the live pipeline: frame in, action out; a ``SensorModel``.

    Parameters
    ----------
    policy : Policy
        A policy whose observations are pins.
    goal : (G,) float, optional
        Default: the policy's own goal.
    contacts : KnownContacts, optional
        The contacts that the policy knows. There is no action for others.

    Raises
    ------
    PolicyError
        If the policy's observations are not pins.
    """

    counts_from_rest = True

    def __init__(self, policy: Policy, *, goal: FloatArray | None = None, contacts: KnownContacts | None = None) -> None:
        if (seen := policy.about["observation"]) != "pins":
            raise PolicyError(f"a policy that sees {seen!r} can't be run on frames; train one with observation 'pins'")
        self.policy, self.contacts = policy, contacts
        self.sensor = SensorSpec.model_validate(policy.about["sensor"])
        self.form = Form.PROCESSED if self.sensor.recording else Form.RAW
        self._nominal = nominal_reference(self.sensor, self.form)
        self._goal = np.asarray(policy.about["goal"] if goal is None else goal, np.float32)
        self._stack: list[FloatArray] = []
        self.pipeline = Pipeline(self.sensor, self.form)
        self._displacements = self._displacements_from(self.pipeline.reference, "")

    def at_rest(self, frame: Frame) -> "PolicyModel":
        """The same policy; it measures the pins' displacements from a frame without contact."""
        reference = measure_reference(self.sensor, self.form, frame)
        found = PolicyModel(self.policy, goal=self._goal, contacts=self.contacts)
        found.pipeline = Pipeline(self.sensor, self.form, reference)
        found._displacements = self._displacements_from(reference, frame.name)
        return found

    def seeking_rest(self) -> "PolicyModel":
        """The policy itself, because it has no model of how contacts displace pins."""
        return self

    def _displacements_from(self, rest: Reference, name: str) -> Displacements:
        if self.contacts is not None:
            return self.contacts.seen_from(rest, name or "the frame without contact")
        spacing_px = float(self._nominal.spacing_px.mean())
        return lambda nodes_px, _: ((nodes_px - rest.pins_px) / spacing_px, "")

    def check(self, sensor: SensorSpec, form: Form) -> None:
        """Raise ``FrameError`` for frames of another sensor or form."""
        if sensor.name != self.sensor.name or form != self.form:
            own = f"{self.form} frames of '{self.sensor.name}'"
            raise FrameError(f"the policy was trained for {own}; these are {form} frames of '{sensor.name}'")

    def __call__(self, frame: Frame) -> PolicyAction:
        """The action for a frame. It is not valid if too few pins are found, or if they show a contact that the policy does not know."""
        seen, moved = self.pipeline(frame), None
        reason = seen.reason
        if seen.graph is not None:
            moved, reason = self._displacements(seen.graph.nodes_px, np.isnan(seen.pins_px[:, 0]))
        if moved is None or reason:
            return PolicyAction(seen, reason, self.policy.axes, np.full(len(self.policy.axes), np.nan))
        count = int(self.policy.about["stack"])
        self._stack = [*(self._stack or [moved] * count), moved][-count:]
        action = self.policy.act(np.array(self._stack)[None], self._goal[None])[0]
        return PolicyAction(seen, "", self.policy.axes, action, valid=True)
