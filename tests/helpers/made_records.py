"""Records of small random pictures and numbers: what is tested is the way through the formats."""

import numpy as np

from twin.records import About, Episode, RecordStep
from twin.types import Form

PINS = 7
ABOUT = About(
    sensor="mg400-127",
    form=Form.PROCESSED,
    size_px=(32, 24),
    gray=True,
    numbers={"pins": 2 * PINS, "pose": 6, "move": 6, "wrench": 6, "estimate": 2, "low": 2, "high": 2, "action": 6},
    estimates=("pose_2", "force_z"),
    frame="base",
    robot="mg400",
)
COLOUR = About("ur5-331", Form.RAW, (20, 30), False, {"pose": 6})
T_TOOL_SENSOR = np.array([[0.0, 1, 0, 5], [-1, 0, 0, 6], [0, 0, 1, 70.5], [0, 0, 0, 1]])


def made_steps(about: About, seed: int, length: int):
    """The steps of one episode; one pin and one estimate in it are NaN."""
    rng = np.random.default_rng(seed)
    width, height = about.size_px
    for k in range(length):
        values = {name: rng.normal(0, 200, about.shape(name)).astype(np.float32) for name in about.numbers}
        if "pins" in values:
            values["pins"][k % PINS] = np.nan
        if "estimate" in values and k == 1:
            values["estimate"][:] = np.nan
        image = rng.integers(0, 256, (height, width) if about.gray else (height, width, 3), np.uint8)
        yield RecordStep(image, round(0.1 * k + 0.001 * bool(k), 9), values)


def made_episode(seed: int, length: int = 3, about: About = ABOUT) -> Episode:
    """An episode that depends on its arguments alone."""
    width, height = about.size_px
    rest = np.random.default_rng([seed, 1]).integers(0, 256, (height, width) if about.gray else (height, width, 3), np.uint8)
    started_s = 1_700_000_000.25 + seed
    return Episode(f"e{seed}", f"task {seed % 2}", lambda: made_steps(about, seed, length), length, rest, started_s, T_TOOL_SENSOR)


def assert_same(a: Episode, b: Episode) -> None:
    """All but the picture without contact is the same to the last bit."""
    assert a.facts() == b.facts()
    mine, its = list(a.steps()), list(b.steps())
    assert [step.time_s for step in mine] == [step.time_s for step in its]
    for one, other in zip(mine, its, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        assert list(one.values) == list(other.values)
        for name, values in one.values.items():
            np.testing.assert_array_equal(values, other.values[name], err_msg=name)
