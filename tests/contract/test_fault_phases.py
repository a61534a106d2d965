"""Every fault switch in every phase of a move: never moving unattended, and never a wait of over two seconds without a word.

``tests/bench/bench_faults.py`` prints the table of what is told, when, and where the arm stands.
"""

import pytest
from fault_phases import CASES, LIMIT_S, PHASES, measure

HANG_S = 2.0  # of a call, beyond the time that it was given
SOME = ("no-move-reply", "frozen", "collision", "mute", "silent", "protective-stop")


def check(case):
    found = measure(*case)
    assert found.loud or not found.moves, found
    given_s = 0.0 if found.phase == "stopping" else LIMIT_S
    assert found.longest_s < max(given_s, LIMIT_S) + HANG_S, found
    assert found.told or found.stands_mm < 66.0


@pytest.mark.parametrize("phase", PHASES)
@pytest.mark.parametrize("fault", SOME)
def test_some_faults(fault, phase):
    check(next(case for case in CASES if case[1:] == (fault, phase)))


@pytest.mark.slow
@pytest.mark.parametrize("case", [case for case in CASES if case[1] not in SOME], ids="-".join)
def test_every_other_fault(case):
    check(case)
