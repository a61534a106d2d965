"""Processes that share work: they do all of it, listen to nobody, and end with the process that started them, however it ends."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import psutil
import pytest
from shared_tasks import dying, failing, named, warning

from twin.errors import FrameError, WorkersError
from twin.workers import in_processes, outcomes

ROOT = Path(__file__).parents[2]
PATIENCE_S = 60.0
ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests" / "helpers")])}
FIRST_PROCESSES = """
from shared_tasks import blocked
from twin.workers import in_processes
if __name__ == "__main__":
    print(*map(len, in_processes(blocked, (), [1, 2, 3], processes=2)))
"""
MAIN = """
import signal
import sys
from shared_tasks import sleeping
from twin.workers import in_processes
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a job in the background of a script begins with SIGINT ignored
    try:
        list(in_processes(sleeping, (sys.argv[1],), [1, 2, 3], processes=2))
    except KeyboardInterrupt:
        sys.exit("interrupted")
"""


def listening(pid_text: str, index: int) -> list[str]:
    """Addresses on which the process that asks and those below it listen."""
    asks, found = psutil.Process(int(pid_text)), []
    for process in (asks, *asks.children(recursive=True)):
        with suppress(psutil.NoSuchProcess):  # a task that is done
            found += [str(c.laddr) for c in process.net_connections(kind="inet") if c.status == psutil.CONN_LISTEN]
    return found


def test_every_task_is_done_once_by_this_process_or_by_others():
    tasks = list(range(9))
    for processes in (1, 2):
        made = list(in_processes(named, ("task ",), tasks, processes=processes))
        assert sorted(text for text, _ in made) == [f"task {task}" for task in tasks]
        assert (os.getpid() in {pid for _, pid in made}) is (processes == 1)
    assert list(in_processes(named, ("",), [], processes=2)) == []
    with pytest.raises(ValueError, match="at least 1"):
        list(in_processes(named, ("",), tasks, processes=0))


@pytest.mark.parametrize("where", ["begin", "task"])
def test_an_error_of_a_task_is_the_callers(where):
    with pytest.raises(FrameError, match=where):
        list(in_processes(failing, (where,), [1, 2], processes=2))


def test_a_warning_of_all_processes_is_given_once():
    with pytest.warns(RuntimeWarning, match="the disk is slow") as told:
        assert os.getpid() not in list(in_processes(warning, (), [1, 2, 3, 4], processes=2))
    assert len(told) == 1


def test_a_lost_process_is_replaced(tmp_path):
    assert sorted(in_processes(dying, (str(tmp_path),), ["a", "b"], processes=2)) == ["a", "b"]


def test_a_task_that_always_ends_its_process_is_given_up_when_the_others_are_done(tmp_path):
    done = []
    with pytest.raises(WorkersError, match="1 of 2 tasks .*enough memory.*resumes from there"):
        for task in in_processes(dying, (str(tmp_path), "a"), ["a", "b"], processes=2):
            done.append(task)
    assert done == ["b"]


def test_processes_that_share_work_listen_nowhere():
    before = set(listening(str(os.getpid()), 0))
    assert set(sum(outcomes(listening, str(os.getpid()), [0, 1], workers=2, scheduler=""), [])) <= before


def test_the_first_processes_are_deaf_to_ctrl_c_from_their_start(tmp_path):
    """Otherwise Ctrl-C prints the traceback of a process that still starts. Python's own helper is started with the first one."""
    script = tmp_path / "main.py"
    script.write_text(FIRST_PROCESSES)
    told = subprocess.run([sys.executable, str(script)], env=ENVIRONMENT, capture_output=True, text=True, timeout=PATIENCE_S)
    assert told.stdout.split() == ["1"] * 3, told.stderr


@pytest.mark.parametrize("moment", ["begun", "at work *"])
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT], ids=lambda end: end.name)
def test_no_process_is_left_when_the_main_one_ends(tmp_path, end, moment):
    """SIGINT comes to all processes of the terminal, as Ctrl-C does; the others to the main process alone."""
    script = tmp_path / "main.py"
    script.write_text(MAIN)
    run = [sys.executable, str(script), str(tmp_path)]
    with subprocess.Popen(run, env=ENVIRONMENT, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        ends = time.monotonic() + PATIENCE_S
        while not list(tmp_path.glob(moment)) and process.poll() is None and time.monotonic() < ends:
            time.sleep(0.01)
        assert process.poll() is None, process.stderr.read()
        below = psutil.Process(process.pid).children(recursive=True)
        assert len(below) >= 2
        try:
            (os.killpg if end == signal.SIGINT else os.kill)(process.pid, end)
            said = process.communicate(timeout=PATIENCE_S)[1]
        finally:
            process.kill()
    _, left = psutil.wait_procs(below, timeout=PATIENCE_S)
    assert not left
    assert process.returncode == (1 if end == signal.SIGINT else -end)
    assert said == ("interrupted\n" if end == signal.SIGINT else "")
