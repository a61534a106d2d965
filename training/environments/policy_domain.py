"""The domain of a policy: the patterns of displaced pins that it was trained on. The policy does not act on other frames.

The domain of a policy for a sensor with shipped weights is that of these weights, which contains real contacts. The domain of another
policy contains the contacts of its own training.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from scenes.sensor import SensorSpec
from training.environments.environment import TactileVectorEnv
from training.estimate.domain import Domain, domain_arrays, domain_of, learn_domain
from training.estimate.estimator import PoseEstimator
from training.runs.run_files import shipped_names
from twin.pins import Reference, nominal_reference, view_of
from twin.pins.labelling.reference import camera_modes
from twin.policy import Displacements, Policy, PolicyError
from twin.types import BoolArray, FloatArray, Form

ACTING_STEPS, WALKING, NOISE = 200, 0.5, 0.01
"""Steps of the environments from which a domain is learnt, the share of rows that move at random instead of by the policy, and the standard
deviation of noise that is added to the pins, in spacings."""
NO_LABEL, NO_UNIT = np.zeros(1), ("",)


def with_domain(policy: Policy, vector: TactileVectorEnv, *, seed: int = 0) -> Policy:
    """The policy with the domain of its own motions and of random ones.

    It is unchanged if it does not see pins, if there are weights of its sensor, or for too few frames.
    """
    sensor = vector.batch.sensor
    if policy.about["observation"] != "pins" or _shipped_estimator(sensor) is not None:
        return policy
    rng = np.random.default_rng([seed, 9])
    seen, _ = vector.reset(seed=seed)
    walking = np.arange(vector.num_envs) < WALKING * vector.num_envs
    drift = np.zeros((vector.num_envs, len(policy.axes)))
    rows, episodes, episode = [], [], np.arange(vector.num_envs)
    for _ in range(ACTING_STEPS):
        drift = np.clip(0.8 * drift + 0.4 * rng.normal(size=drift.shape), -1, 1)
        seen, _, ended, cut, _ = vector.step(np.where(walking[:, None], drift, policy.act(seen["tactile"], seen["goal"])))
        rows.append(seen["tactile"][:, -1])
        episode = np.where(ended | cut, episode + vector.num_envs, episode)
        episodes.append(episode)
    moved = np.concatenate(rows).astype(float)
    moved += rng.normal(0, NOISE, moved.shape)
    reference = nominal_reference(sensor, Form.PROCESSED if sensor.recording else Form.RAW)
    learnt = learn_domain(
        moved, np.zeros((len(moved), 1)), reference, NO_UNIT, least=NO_LABEL, group=np.concatenate(episodes), simulated=True, seed=seed
    )
    if learnt is None:
        return policy
    arrays, about = domain_arrays(learnt)
    return replace(policy, about={**policy.about, "domain": about}, domain=arrays)


@dataclass(frozen=True)
class LearntContacts:
    """The contacts in a domain, for pins that any camera of the sensor sees: a ``KnownContacts``.

    Attributes
    ----------
    domain : Domain
    reference : Reference
        Pins at rest of which the domain knows the displacements.
    require_view : callable
        Raises ``FrameError`` for pins at rest (N, 2) in a frame of some name that show a turned, mirrored or stretched view.
    """

    domain: Domain
    reference: Reference
    require_view: Callable[[FloatArray, str], object]

    def seen_from(self, rest: Reference, name: str) -> Displacements:
        """See ``KnownContacts``. Displacements are those that the camera of the domain would see."""
        self.require_view(rest.pins_px, name)
        linear = rest.map_to(self.reference)

        def displacements(nodes_px: FloatArray, lost: BoolArray) -> tuple[FloatArray, str]:
            moved = (nodes_px - rest.pins_px) @ linear / float(self.reference.spacing_px.mean())
            reason = self.domain.assess(moved, lost, self.reference, corrects=False).reason
            if lost.any() and not reason:
                moved = self.domain.fill_lost(moved, lost)[0]
            return moved, reason

        return displacements


def contacts_of(policy: Policy) -> LearntContacts | None:
    """The contacts that a policy knows; None if neither the policy nor weights of its sensor hold a domain.

    Raises
    ------
    PolicyError
        The domain is damaged, or belongs to another sensor.
    """
    sensor = SensorSpec.model_validate(policy.about["sensor"])
    shipped = _shipped_estimator(sensor)
    if shipped is not None and shipped.domain is not None:
        return LearntContacts(shipped.domain, shipped.trained_reference, shipped.rest.require_view)
    if not policy.domain:
        return None
    try:
        domain = domain_of(policy.domain, policy.about["domain"], sensor.pins.count, 1)
    except (KeyError, TypeError, ValueError) as error:
        raise PolicyError(f"the policy's domain is damaged ({error}); learn the policy again with 'twin learn'") from error
    form = Form.PROCESSED if sensor.recording else Form.RAW
    reference = nominal_reference(sensor, form)

    def require_view(pins_px: FloatArray, name: str) -> None:
        view_of(pins_px, reference, sensor.pins, camera_modes(sensor, form)).require_small(name, f"the policy's sensor {sensor.name}")

    return LearntContacts(domain, reference, require_view)


def _shipped_estimator(sensor: SensorSpec) -> PoseEstimator | None:
    """The shipped weights of a sensor, if they are for the same pins."""
    if sensor.name not in shipped_names():
        return None
    found = PoseEstimator.load(sensor.name)
    return found if found.sensor.pins == sensor.pins else None
