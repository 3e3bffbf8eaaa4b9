"""The monitor of a specification as a ROS 2 node: topics in, verdicts on /diagnostics.

    python examples/ros2_monitor.py speed.stl --dt 0.1 \
        --signal v=/odom:twist.twist.linear.x --type /odom=nav_msgs/msg/Odometry

With a sourced ROS 2 this is a real node, until it is interrupted; otherwise `ros2_standins.py` replaces ROS.
Every `dt` the node takes the latest value of each signal as one sample; a signal without a message yet is
unknown.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Mapping
from functools import partial, reduce

from stlc import Monitor
from stlc.monitor.online import How
from stlc.monitor.online.online import Decision

try:
    import rclpy
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
    from rclpy.node import Node
    from rosidl_runtime_py.utilities import get_message

    ROS = True
except ImportError:
    from ros2_standins import DiagnosticArray, DiagnosticStatus, KeyValue, Node

    ROS = False

OK, ERROR = b"\x00", b"\x02"
"""Levels of a diagnostic."""


class MonitorNode(Node):
    """Judges a sample every `dt`, and publishes the verdicts that it decides.

    Args:
        monitor: the specification.
        dt: time step in seconds.
        topics: signal -> topic and path of the field in its messages, as in `/odom:twist.twist.linear.x`.
        types: topic -> type of its messages.
    """

    def __init__(
        self, monitor: Monitor, dt: float, topics: Mapping[str, str], types: Mapping[str, type]
    ) -> None:
        super().__init__("stlc_monitor")
        self.online = monitor.online(How(reasons=True), dt=dt)
        if missing := set(self.online.signals) - set(topics):
            raise SystemExit(f"no topic for the signals {', '.join(sorted(missing))}")
        self.latest = dict.fromkeys(self.online.signals, math.nan)
        for signal in self.online.signals:
            topic, _, field = topics[signal].partition(":")
            self.create_subscription(
                types.get(topic, object), topic, partial(self.on_message, signal, field), 10
            )
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self.create_timer(dt, self.on_timer)

    def on_message(self, signal: str, field: str, message: object) -> None:
        """Store the value of a signal."""
        self.latest[signal] = float(reduce(getattr, field.split("."), message))

    def on_timer(self) -> None:
        """Judge the latest values as one sample."""
        if self.online.push([self.latest[signal] for signal in self.online.signals]):
            told = [self.told(each) for each in self.online.verdicts()]
            self.diagnostics.publish(DiagnosticArray(status=told))

    def told(self, decision: Decision) -> DiagnosticStatus:
        """A verdict as a diagnostic; a violation with its cause, if no worse one was told before."""
        violated = decision.status == "violated"
        cause = self.online.cause(decision.requirement) if violated else None
        if cause is not None and decision.start != cause.start and decision.sample != cause.sample:
            cause = None
        low, high = self.online.bounds(decision.requirement, decision.start)
        values = {"start": f"{decision.time:g} s", "low": f"{low:g}", "high": f"{high:g}"}
        return DiagnosticStatus(
            level=ERROR if violated else OK,
            name=f"stlc: {decision.requirement}",
            message=decision.status if cause is None else cause.because,
            values=[KeyValue(key=key, value=value) for key, value in values.items()],
        )


def main() -> None:
    """Run the node with the specification and the topics of the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("spec")
    parser.add_argument("--dt", type=float, required=True, help="time step in seconds")
    parser.add_argument("--signal", action="append", default=[], metavar="NAME=TOPIC:FIELD")
    parser.add_argument("--type", action="append", default=[], metavar="TOPIC=PACKAGE/msg/TYPE")
    parser.add_argument("--seconds", type=float, default=1.0, help="simulated time without ROS")
    asked = parser.parse_args()
    for each in asked.signal:
        if not re.fullmatch(r"[^=]+=[^:]+:.+", each):
            parser.error(f"--signal {each} is not NAME=TOPIC:FIELD")
    topics = dict(each.split("=", 1) for each in asked.signal)
    if not ROS:
        MonitorNode(Monitor(asked.spec), asked.dt, topics, {})
        Node.bus.spin(asked.seconds)
        return
    rclpy.init()
    types = {topic: get_message(name) for topic, _, name in (each.partition("=") for each in asked.type)}
    node = MonitorNode(Monitor(asked.spec), asked.dt, topics, types)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
