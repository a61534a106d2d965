"""Half an hour of the streamed loop with both emulators in processes of their own, and a random fault every 20 s.

Run ``python tests/bench/bench_endurance.py [SECONDS [SEED]]`` with tests/helpers on the path.
"""

import logging
import sys

from endurance import endure

from training.estimate.estimator import PoseEstimator

SECONDS = 1800.0


def main() -> None:
    """Run it, and print every fault, every round and the figures of all."""
    logging.getLogger("hardware").setLevel(logging.ERROR)
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    seed = int(sys.argv[2]) if len(sys.argv) > 2 else 0
    found = endure(PoseEstimator.load("mg400-331"), seconds, seed=seed, report=lambda line: print(line, flush=True))
    print("\n".join(found.lines()))
    moving = [one for one in found.rounds if one.moves_on]
    print(f"rounds after which the arm moved on: {len(moving)}")
    for one in moving:
        print(f"  {one.told}")


if __name__ == "__main__":
    main()
