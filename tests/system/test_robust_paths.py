"""Random contacts over the range of the recordings: every load step converges (make validate).

Run by hand for more: python tests/system/test_robust_paths.py --object plane --paths 100 [--first 0]. A path is known by
its number, so that one that fails can be looked at alone: --first 17 --paths 1.
"""

import argparse
from time import process_time

import numpy as np
import pytest

from scenes import load_object, load_sensor
from twin.errors import ContactError
from twin.mechanics.newton import RESIDUAL_TOLERANCE
from twin.mechanics.path import ContactPose
from twin.mechanics.solver import SkinSolver

SENSOR = "mg400-331"
INDENT_MM, TILT_DEG, SHEAR_MM, TWIST_DEG, FRICTION = (0.5, 5.0), 25.0, 2.5, 10.0, (0.05, 1.5)
PATHS = {"plane": 16, "sphere": 3, "edge": 8, "can": 3, "square": 3, "mesh-can": 2}


def random_contact(number: int) -> tuple[ContactPose, float]:
    """Pose and coefficient of friction (log-uniform) number ``number``."""
    rng = np.random.default_rng(number)
    tilt_deg = np.zeros(2)
    tilt_deg[rng.integers(2)] = rng.uniform(-TILT_DEG, TILT_DEG)
    shear_mm, azimuth = rng.uniform(0, SHEAR_MM), rng.uniform(0, 2 * np.pi)
    pose = ContactPose(
        indent_mm=round(rng.uniform(*INDENT_MM), 3),
        tilt_deg=tuple(tilt_deg.round(2).tolist()),
        shear_mm=(round(float(shear_mm * np.cos(azimuth)), 3), round(float(shear_mm * np.sin(azimuth)), 3)),
        twist_deg=round(rng.uniform(-TWIST_DEG, TWIST_DEG), 2),
    )
    return pose, round(float(np.exp(rng.uniform(*np.log(FRICTION)))), 3)


def failures(solver: SkinSolver, name: str, numbers: range) -> list[str]:
    """What went wrong, one line for each path that did; says on the way what each path cost."""
    spec, out = load_object(name), []
    for number in numbers:
        pose, friction = random_contact(number)
        start, states, wrong = process_time(), 0, ""
        try:
            for _, state in solver.path(spec, pose, friction=friction):
                states += 1
                tangential = np.linalg.norm(state.tangential_n, axis=1)
                if state.residual > RESIDUAL_TOLERANCE or (tangential > friction * state.normal_n * (1 + 1e-6) + 1e-9).any():
                    wrong = f"state {states}: residual {state.residual:.1e}, friction beyond its cone or not converged"
        except ContactError as error:
            wrong = str(error)
        print(f"{name} {number}: {states} states, {process_time() - start:.1f} s{', FAILED' if wrong else ''}", flush=True)
        if wrong:
            out.append(f"{name} {number}: friction {friction}, {pose}: {wrong}")
            print(out[-1], flush=True)
    return out


@pytest.fixture(scope="module")
def solver():
    return SkinSolver(load_sensor(SENSOR))


@pytest.mark.slow
@pytest.mark.parametrize("name", PATHS)
def test_random_paths_converge(solver, name):
    failed = failures(solver, name, range(PATHS[name]))
    assert not failed, "\n".join(failed)


def main():
    """Press as many random contacts as asked for and count the failures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default=SENSOR)
    parser.add_argument("--object", default="plane")
    parser.add_argument("--paths", type=int, default=8)
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args()
    failed = failures(SkinSolver(load_sensor(options.sensor)), options.object, range(options.first, options.first + options.paths))
    print(f"{options.paths - len(failed)} of {options.paths} converged", *failed, sep="\n")


if __name__ == "__main__":
    main()
