"""What the tests over DDS share: the node as a process of its own, and the other end in the test's."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

rclpy = pytest.importorskip('rclpy')

from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402

DOMAIN = 1 + os.getpid() % 100
START_TIMEOUT_S = 120  # the first start compiles
TIMEOUT_S = 20


def environment(folder: Path) -> dict[str, str]:
    """Return the environment of a process on the tests' own domain, which logs into ``folder``."""
    return {
        **os.environ, 'ROS_DOMAIN_ID': str(DOMAIN), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_LOG_DIR': str(folder), 'RCUTILS_COLORIZED_OUTPUT': '0',
    }


class NodeProcess:
    """The node under test."""

    def __init__(self, folder: Path, *arguments: str) -> None:
        self.log = folder / f'node_{time.monotonic_ns()}.log'
        with self.log.open('w') as log:
            self.process = subprocess.Popen(
                [sys.executable, '-m', 'beacon_comm.ros.node', '--ros-args', *arguments],
                stdout=log, stderr=subprocess.STDOUT, env=environment(folder), cwd=folder,
            )

    def output(self) -> str:
        return self.log.read_text()

    def wait_for(self, text: str, timeout_s: float = START_TIMEOUT_S) -> None:
        deadline = time.monotonic() + timeout_s
        while text not in self.output():
            assert self.process.poll() is None, self.output()
            assert time.monotonic() < deadline, f'no {text!r} in:\n{self.output()}'
            time.sleep(0.02)

    def exit_code(self, timeout_s: float = TIMEOUT_S) -> int:
        return self.process.wait(timeout_s)

    def kill(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
            self.process.wait()


class Peer:
    """The other end: a driver and a listener in the test's own process."""

    def __init__(self, name: str) -> None:
        self.context = rclpy.Context()
        self.context.init(domain_id=DOMAIN)
        self.node = rclpy.create_node(name, context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.node)
        self.heard: dict[str, list[Any]] = defaultdict(list)
        self.publisher: Any = None

    def listen(self, topic: str, kind: Any, latched: bool = False) -> None:
        durability = DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE
        qos = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE, durability=durability)
        self.node.create_subscription(kind, topic, self.heard[topic].append, qos)

    def advertise(self, kind: Any, topic: str, reliability: ReliabilityPolicy) -> None:
        self.publisher = self.node.create_publisher(kind, topic, QoSProfile(depth=1000, reliability=reliability))

    def spin_until(self, condition: Callable[[], object], timeout_s: float = TIMEOUT_S) -> bool:
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                return False
            self.executor.spin_once(timeout_sec=0.02)
        return True

    def spin_for(self, seconds: float) -> None:
        self.spin_until(lambda: False, seconds)

    def close(self) -> None:
        self.executor.shutdown()
        self.node.destroy_node()
        self.context.try_shutdown()
