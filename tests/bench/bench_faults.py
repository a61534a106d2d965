"""The table of faults: each switch of the emulated arms in each phase of a move, what the user is told, when, and where the arm stands.

Run ``python tests/bench/bench_faults.py`` with tests/helpers on the path. It takes some minutes.
"""

from fault_phases import CASES, measure


def main() -> None:
    """Measure and print every case, and the figures of all."""
    print("| arm | fault | phase | the user is told | after, s | the arm |\n| --- | --- | --- | --- | --- | --- |")
    found = []
    for case in CASES:
        found.append(measure(*case))
        print(found[-1].row(), flush=True)
    told = [one for one in found if one.told]
    print(f"\n{len(found)} cases, {len(told)} end in an error; the longest call took {max(one.longest_s for one in found):.2f} s.")
    print(f"Moving unattended without a warning: {sum(one.moves and not one.loud for one in found)}.")


if __name__ == "__main__":
    main()
