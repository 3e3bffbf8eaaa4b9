"""Substitutes for ROS 2 in `ros2_callback.py`: messages, nodes, and simulated time.

Messages have the used fields of ROS messages; nodes have the used methods of `rclpy.node.Node`.
"""

from __future__ import annotations

import heapq
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from typing import Any


@dataclass
class Vector3:
    """`geometry_msgs/Vector3` and `Point`."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


@dataclass
class Quaternion:
    """`geometry_msgs/Quaternion`."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


@dataclass
class Pose:
    """`geometry_msgs/Pose`."""

    position: Vector3 = field(default_factory=Vector3)
    orientation: Quaternion = field(default_factory=Quaternion)


@dataclass
class PoseWithCovariance:
    """`geometry_msgs/PoseWithCovariance`."""

    pose: Pose = field(default_factory=Pose)


@dataclass
class Twist:
    """`geometry_msgs/Twist`."""

    linear: Vector3 = field(default_factory=Vector3)
    angular: Vector3 = field(default_factory=Vector3)


@dataclass
class TwistWithCovariance:
    """`geometry_msgs/TwistWithCovariance`."""

    twist: Twist = field(default_factory=Twist)


@dataclass
class Odometry:
    """`nav_msgs/Odometry`."""

    pose: PoseWithCovariance = field(default_factory=PoseWithCovariance)
    twist: TwistWithCovariance = field(default_factory=TwistWithCovariance)


@dataclass
class String:
    """`std_msgs/String`."""

    data: str = ""


@dataclass
class KeyValue:
    """`diagnostic_msgs/KeyValue`."""

    key: str = ""
    value: str = ""


@dataclass
class DiagnosticStatus:
    """`diagnostic_msgs/DiagnosticStatus`."""

    level: bytes = b"\x00"
    name: str = ""
    message: str = ""
    values: list[KeyValue] = field(default_factory=list)


@dataclass
class DiagnosticArray:
    """`diagnostic_msgs/DiagnosticArray`."""

    status: list[DiagnosticStatus] = field(default_factory=list)


class Bus:
    """Topics, timers and simulated time, for all nodes of a process."""

    def __init__(self) -> None:
        self.topics: dict[str, list[Callable[[Any], None]]] = defaultdict(list)
        self._due: list[tuple[float, int, float, Callable[[], None]]] = []
        self._order = count()

    def every(self, period: float, call: Callable[[], None], at: float = 0.0) -> None:
        """Add a timer; of several that are due, the oldest is called first."""
        heapq.heappush(self._due, (round(at, 9), next(self._order), period, call))

    def spin(self, seconds: float) -> None:
        """Advance simulated time by `seconds`."""
        while self._due and self._due[0][0] < seconds - 1e-9:
            now, _, period, call = heapq.heappop(self._due)
            call()
            self.every(period, call, now + period)


class Publisher:
    """`rclpy.publisher.Publisher`: callbacks run at once."""

    def __init__(self, listeners: list[Callable[[Any], None]]) -> None:
        self.listeners = listeners

    def publish(self, message: object) -> None:
        """Call all subscribers."""
        for listener in self.listeners:
            listener(message)


class Node:
    """Substitute for `rclpy.node.Node`."""

    bus = Bus()

    def __init__(self, name: str) -> None:
        self.name = name

    def create_subscription(self, kind: type, topic: str, call: Callable[[Any], None], depth: int) -> None:  # noqa: ARG002
        """Subscribe to a topic."""
        self.bus.topics[topic].append(call)

    def create_publisher(self, kind: type, topic: str, depth: int) -> Publisher:  # noqa: ARG002
        """Create a publisher of a topic."""
        return Publisher(self.bus.topics[topic])

    def create_timer(self, period: float, call: Callable[[], None]) -> None:
        """Call something every `period` seconds."""
        self.bus.every(period, call)
