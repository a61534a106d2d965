"""How fast the studio answers, measured end to end by a client of the page: from a move of the gizmo to skin, picture and numbers.

    python tests/bench/bench_studio.py --sensor mg400-331 --object sphere --seconds 30

Random drags go on for ``--seconds``; every move has a depth of its own, by which its answer is known. It is checked that pictures, scene
and numbers come together, and that no answer comes twice or out of order. At the end: time to the path-traced picture, and memory.
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sensor", default="mg400-331")
    parser.add_argument("--object", default="sphere")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--rate", type=float, default=20.0, help="gizmo moves a second")
    parser.add_argument("--out", type=Path, default=Path("out/studio-bench"))
    args = parser.parse_args()
    radius = load_sensor(args.sensor).skin.outer_radius_mm
    rng = np.random.default_rng(0)
    process, url, begun = start(args.sensor, args.object, args.out)
    try:
        with StudioClient(url) as client:
            first = client.wait(lambda u: u.number > 0, 60)
            print(f"first picture {first.time_s - begun:.1f} s after the command")
            client.wait(lambda u: "90 % interval" in u.html, 120)
            client.wait(lambda u: "path-traced" in u.html, 120)
            sent: list[tuple[float, float]] = []
            place, speed, since, ended = (
                np.array([0.0, 0.0, -1.0]),
                rng.normal(0, 6, 3),
                len(client.updates),
                time.monotonic() + args.seconds,
            )
            memory, spent = [memory_mb(process)], cpu_s(process)
            while time.monotonic() < ended:
                speed += rng.normal(0, 4, 3) - 0.3 * speed - 0.8 * (place - [0, 0, 2.0])
                place = np.clip(place + speed / args.rate, [-5, -5, -2], [5, 5, 4.5])
                depth = round(float(place[2]), 2) + len(sent) % 1000 * 1e-5
                sent.append((time.monotonic(), depth))
                client.drag((float(place[0]), float(place[1]), radius - depth))
                if len(sent) % 200 == 0:
                    memory.append(memory_mb(process))
                time.sleep(1 / args.rate)
            stopped = sent[-1][0]
            answers = [u for u in client.updates[since:] if u.number > 0]
            times = dict((round(d, 6), t) for t, d in sent)
            late = [u.time_s - times[u.depth_mm] for u in answers if u.depth_mm in times]
            gaps = np.diff([u.time_s for u in answers])
            moved = [u for before, u in zip(answers, answers[1:], strict=False) if u.depth_mm != before.depth_mm]
            together = np.mean([u.pictures >= 2 and "/object" in u.nodes for u in moved])
            numbers = [u.number for u in answers]
            traced = client.wait(lambda u: "path-traced" in u.html and u.number > numbers[-1], 60, since=len(client.updates) - 5)
            memory.append(memory_mb(process))
            result = {
                "sensor": args.sensor,
                "object": args.object,
                "moves": len(sent),
                "answers": len(answers),
                "answers_per_s": round(len(answers) / args.seconds, 1),
                "between_answers_ms": [round(1e3 * float(np.percentile(gaps, q))) for q in (50, 95)],
                "move_to_page_ms": [round(1e3 * float(np.percentile(late, q))) for q in (50, 95)],
                "together": float(together),
                "in_order": bool((np.diff(numbers) > 0).all()),
                "still_to_traced_s": round(traced.time_s - stopped, 2),
                "cpu_ms_per_answer": round(1e3 * (cpu_s(process) - spent) / len(answers)),
                "memory_mb": [round(m) for m in memory],
                "load": psutil.getloadavg()[0],
            }
            print(json.dumps(result))
    finally:
        process.terminate()
        process.wait(20)


if __name__ == "__main__":
    main()
