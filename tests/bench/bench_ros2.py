"""Delay and CPU time of pictures that go between two processes as ROS 2 topics: 640 x 480 gray at 30 Hz, raw and compressed.

    python tests/bench/bench_ros2.py [--seconds 20]

One process publishes what a camera delivers, the other reads both topics. A delay is the time from the offer of a frame, encoding
included, to the decoded message (Image: an array; CompressedImage: the JPEG's bytes) at the reader.
"""

import argparse
import os
import subprocess
import sys
import time

import numpy as np

from hardware.ros2.dds import Participant
from hardware.workcell.ros2 import Ros2Publisher
from scenes import load_sensor
from twin.pins import Pipeline
from twin.records.ros2 import decode
from twin.types import Form, Frame

HZ = 30.0
TOPICS = {"/bench/image": "sensor_msgs/Image", "/bench/image/compressed": "sensor_msgs/CompressedImage"}


class Offered:
    """A live source of which every frame is offered by hand."""

    name, form, is_live, streams, fault, dropped = "bench", Form.RAW, True, True, "", 0

    def notes(self) -> list[str]:
        return []

    def blind(self) -> str:
        return ""


def read(topic: str, seconds: float) -> None:
    """Print the delays of a topic's messages, ms, and the CPU time of this process."""
    reader = Participant().reader(topic, TOPICS[topic])
    delays, until_s = [], time.monotonic() + seconds
    begun_s = time.process_time()
    while time.monotonic() < until_s:
        for data in reader.take():
            stamp = decode(TOPICS[topic], data)["header"]["stamp"]
            delays.append(time.time() * 1e3 - stamp["sec"] * 1e3 - stamp["nanosec"] / 1e6)
    print(len(delays), *np.percentile(delays[10:], (50, 95)), (time.process_time() - begun_s) / seconds)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--read")
    options = parser.parse_args()
    if options.read:
        read(options.read, options.seconds)
        return
    os.environ.setdefault("ROS_LOCALHOST_ONLY", "1")
    sensor = load_sensor("mg400-331")
    rng = np.random.default_rng(0)
    base = np.kron(rng.integers(0, 2, (24, 32)), np.ones((20, 20))) * 120 + 60
    images = [np.clip(base + rng.normal(0, 3, base.shape), 0, 255).astype(np.uint8) for _ in range(8)]
    with Ros2Publisher("bench", Offered(), Pipeline(sensor, Form.RAW)) as publisher:
        command = [sys.executable, __file__, "--seconds", str(options.seconds), "--read"]
        readers = {topic: subprocess.Popen([*command, topic], stdout=subprocess.PIPE, text=True) for topic in TOPICS}
        while not (publisher._writers["image"].heard and publisher._writers["image/compressed"].heard):
            time.sleep(0.01)
        begun_s, spent_s, count = time.monotonic(), time.process_time(), 0
        while any(reader.poll() is None for reader in readers.values()):
            time.sleep(max(0.0, begun_s + count / HZ - time.monotonic()))
            publisher.offer(Frame(images[count % 8], Form.RAW, "", time.monotonic(), count))
            count += 1
        mine = (time.process_time() - spent_s) / (time.monotonic() - begun_s)
        total = mine
        for topic, reader in readers.items():
            got, p50, p95, cores = map(float, reader.communicate()[0].split())
            total += cores
            print(f"{topic}: {got:.0f} of {count} messages, delay {p50:.1f} ms (median), {p95:.1f} ms (95 %), reader {cores:.2f} of a core")
        print(f"publisher {mine:.2f} of a core, all three processes {total:.2f}")


if __name__ == "__main__":
    main()
