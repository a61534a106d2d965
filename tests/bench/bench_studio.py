"""How fast the studio answers, measured end to end by a client of the page: from a move of the gizmo to skin, picture and numbers.

    python tests/bench/bench_studio.py --sensor mg400-331 --object sphere --seconds 30
    python tests/bench/bench_studio.py --minutes 30

Random drags go on for ``--seconds`` or ``--minutes``, a second's rest after every fifteen; every move has a depth of its own, by which its
answer is known. It is checked that pictures, scene and numbers come together, that no answer comes twice or out of order, that none shows
an earlier wish after a later one, and that in each rest the pose that was wished last is shown, path-traced.
Memory is measured in every rest. It ends with an error if anything of this was wrong.
"""

import argparse
import json
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
from studio_client import StudioClient

from scenes import load_sensor

# Random drags go on for DRAG_S, then nothing moves for REST_S; the pose that was wished last has to be shown within WAIT_S.
DRAG_S, REST_S, WAIT_S = 15.0, 1.0, 30.0
# What the page says of an object that is where it was wished. One on its way may be at any depth, by chance at that of an earlier wish.
ARRIVED = "<span class='badge still'>still</span>"
# Longest wait for the first picture, s: the first start after a change of the code compiles.
COLD_S = 300.0
# Depths that differ by less are the same, mm; those of two wishes differ by more.
SAME_MM = 5e-7


def start(sensor: str, touched: str, out: Path) -> tuple[subprocess.Popen, str, float]:
    """A studio in a process of its own, its address, and the time in s until it said it."""
    begun = time.monotonic()
    code = "from twin.cli import main; main()"
    command = [sys.executable, "-c", code, "studio", "--sensor", sensor, "--object", touched, "--saves", str(out)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    for line in process.stdout:
        if found := re.search(r"http://\S+", line):
            return process, found[0], begun
    raise SystemExit("the studio did not start")


def memory_mb(process: subprocess.Popen) -> float:
    """Memory of the studio and its processes, shared pages counted once."""
    whole = psutil.Process(process.pid)
    return sum(each.memory_full_info().pss for each in [whole, *whole.children(recursive=True)]) / 2**20


def cpu_s(process: subprocess.Popen) -> float:
    """Processor time of the studio without its path tracer, in s."""
    times = psutil.Process(process.pid).cpu_times()
    return times.user + times.system


def rest(client: StudioClient, wish: tuple[float, float]) -> tuple[float, float] | None:
    """Wait until the last wish (its time and depth) is shown path-traced: for how long, s, from the wish and from when it was shown
    at all; None if it never was."""
    since = max(0, len(client.updates) - 50)
    try:
        drawn = client.wait(lambda u: u.number > 0 and abs(u.depth_mm - wish[1]) < SAME_MM, WAIT_S, since=since)
        traced = client.wait(lambda u: "path-traced" in u.html and abs(u.depth_mm - wish[1]) < SAME_MM, WAIT_S, since=since)
    except AssertionError:
        return None
    time.sleep(max(0.0, REST_S - (time.monotonic() - wish[0])))
    return traced.time_s - wish[0], traced.time_s - drawn.time_s


def measure(sensor: str, touched: str, seconds: float, out: Path, *, rate: float = 20.0) -> dict:
    """Drag for a time in s, ``rate`` moves a second; what was found, see the head of this file."""
    radius = load_sensor(sensor).skin.outer_radius_mm
    rng = np.random.default_rng(0)
    process, url, begun = start(sensor, touched, out)
    try:
        with StudioClient(url) as client:
            first = client.wait(lambda u: u.number > 0, COLD_S)
            client.wait(lambda u: "90 % interval" in u.html, 120)
            client.wait(lambda u: "path-traced" in u.html, 120)
            sent: list[tuple[float, float]] = []
            place, speed, since, ended = (np.array([0.0, 0.0, -1.0]), rng.normal(0, 6, 3), len(client.updates), time.monotonic() + seconds)
            memory, spent, rests, rest_s = [memory_mb(process)], cpu_s(process), [], time.monotonic() + DRAG_S
            while time.monotonic() < ended:
                speed += rng.normal(0, 4, 3) - 0.3 * speed - 0.8 * (place - [0, 0, 2.0])
                place = np.clip(place + speed / rate, [-5, -5, -2], [5, 5, 4.5])
                depth = round(20 * float(place[2])) / 20 + len(sent) * 1e-6  # its own for 50 000 moves
                sent.append((time.monotonic(), depth))
                client.drag((float(place[0]), float(place[1]), radius - depth))
                time.sleep(1 / rate)
                if time.monotonic() > rest_s:
                    rests.append(rest(client, sent[-1]))
                    memory.append(memory_mb(process))
                    rest_s = time.monotonic() + DRAG_S
            rests.append(rest(client, sent[-1]))
            answers = [u for u in client.updates[since:] if u.number > 0]
            times = dict((round(d, 6), t) for t, d in sent)
            there = [u for u in answers if ARRIVED in u.html and u.depth_mm in times]
            late = [u.time_s - times[u.depth_mm] for u in there]
            gaps = np.diff([u.time_s for u in answers])
            moved = [u for before, u in zip(answers, answers[1:], strict=False) if u.depth_mm != before.depth_mm]
            together = np.mean([u.pictures >= 2 and "/object" in u.nodes for u in moved])
            numbers = [u.number for u in answers]
            wishes = {round(depth, 6): number for number, (_, depth) in enumerate(sent)}
            shown = [wishes[u.depth_mm] for u in there]
            stale = int((np.diff(shown) < 0).sum())  # an earlier wish after a later one
            memory.append(memory_mb(process))
            waited = [each for each in rests if each is not None]
            to_traced = np.percentile(waited, (50, 95), axis=0).T.round(2).tolist() if waited else [None, None]
            return {
                "first_picture_s": round(first.time_s - begun, 1),
                "sensor": sensor,
                "object": touched,
                "moves": len(sent),
                "answers": len(answers),
                "answers_per_s": round(len(answers) / (seconds - REST_S * (len(rests) - 1)), 1),
                "between_answers_ms": [round(1e3 * float(np.percentile(gaps, q))) for q in (50, 95)],
                "move_to_page_ms": [round(1e3 * float(np.percentile(late, q))) for q in (50, 95)],
                "together": float(together),
                "in_order": bool((np.diff(numbers) > 0).all()),
                "at_their_wish": len(there),
                "stale": stale,
                "rests": len(rests),
                "rests_without_their_pose": rests.count(None),
                "last_move_to_traced_s": to_traced[0],
                "still_to_traced_s": to_traced[1],
                "cpu_ms_per_answer": round(1e3 * (cpu_s(process) - spent) / len(answers)),
                "memory_mb": [round(m) for m in memory],
                "load": psutil.getloadavg()[0],
            }
    finally:
        process.terminate()
        try:
            process.wait(20)
        except subprocess.TimeoutExpired:  # it is compiling
            process.kill()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default="mg400-331")
    parser.add_argument("--object", default="sphere")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--minutes", type=float, default=0.0, help="in place of --seconds")
    parser.add_argument("--rate", type=float, default=20.0, help="gizmo moves a second")
    parser.add_argument("--out", type=Path, default=Path("out/studio-bench"))
    args = parser.parse_args()
    result = measure(args.sensor, args.object, 60 * args.minutes or args.seconds, args.out, rate=args.rate)
    print(json.dumps(result))
    if result["stale"] or result["rests_without_their_pose"] or not result["in_order"]:
        raise SystemExit("something stale was shown")


if __name__ == "__main__":
    main()
