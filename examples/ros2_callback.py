"""An exported controller as a ROS 2 node: odometry in, a velocity command and its verdict out, every `dt`.

    stlc train specs/patrol.stl
    stlc export latest --to onnx -o controller
    python examples/ros2_callback.py controller --seconds 25

With a sourced ROS 2 this is a real node: /odom in, /cmd_vel and /verdict out, until it is interrupted.
Otherwise `ros2_standins.py` replaces ROS, and the same node drives a simulated vehicle in simulated time. It
needs numpy and onnxruntime.
"""

from __future__ import annotations

import argparse
import math

from stlc.diagnostics import StlcError
from stlc.jsontext import dumps
from stlc.runtime import Controller

try:
    import rclpy
    from geometry_msgs.msg import Twist
    from nav_msgs.msg import Odometry
    from rclpy.node import Node
    from std_msgs.msg import String

    ROS = True
except ImportError:
    from ros2_standins import Node, Odometry, String, Twist

    ROS = False


class ControllerNode(Node):
    """Computes a command from the last odometry every `dt`; without a decision it stops the vehicle."""

    def __init__(self, controller: Controller) -> None:
        super().__init__("stlc_controller")
        self.controller = controller
        self.dt = controller.facts.dt
        self.seen: Odometry | None = None
        self.create_subscription(Odometry, "/odom", self.on_odometry, 1)
        self.commands = self.create_publisher(Twist, "/cmd_vel", 1)
        self.verdicts = self.create_publisher(String, "/verdict", 1)
        self.create_timer(self.dt, self.on_timer)

    def on_odometry(self, message: Odometry) -> None:
        """Store the last measurement."""
        self.seen = message

    def on_timer(self) -> None:
        """Decide and publish command and verdict."""
        if self.seen is None:
            return
        state = state_of(self.seen)
        try:
            decision = self.controller.decide(state)
        except StlcError as error:
            self.commands.publish(Twist())
            self.verdicts.publish(String(data=dumps({"stopped": str(error)})))
            return
        omega, accel = (float(value) for value in decision.control)
        command = Twist()
        command.linear.x = state["v"] + accel * self.dt
        command.angular.z = omega
        self.commands.publish(command)
        verdict = {"rule": decision.rule, "rho": decision.rho, **decision.robustness}
        self.verdicts.publish(String(data=dumps(verdict)))


def state_of(message: Odometry) -> dict[str, float]:
    """The state of `examples/unicycle.yaml` in an odometry message."""
    turn = message.pose.pose.orientation
    yaw = math.atan2(2.0 * (turn.w * turn.z + turn.x * turn.y), 1.0 - 2.0 * (turn.y**2 + turn.z**2))
    place = message.pose.pose.position
    return {"x": place.x, "y": place.y, "psi": yaw, "v": message.twist.twist.linear.x}


class Vehicle(Node):
    """A simulated vehicle, one Euler step at a time."""

    def __init__(self, dt: float) -> None:
        super().__init__("vehicle")
        self.dt, self.x, self.y, self.psi, self.v = dt, 0.0, -4.0, 0.5 * math.pi, 0.0
        self.told = Twist()
        self.odometry = self.create_publisher(Odometry, "/odom", 1)
        self.create_subscription(Twist, "/cmd_vel", self.on_command, 1)
        self.create_timer(dt, self.on_timer)

    def on_command(self, message: Twist) -> None:
        """Store the command for the next step."""
        self.told = message

    def on_timer(self) -> None:
        """Move one step and publish the odometry."""
        self.x += self.dt * self.v * math.cos(self.psi)
        self.y += self.dt * self.v * math.sin(self.psi)
        self.psi += self.dt * self.told.angular.z
        self.v = min(max(self.told.linear.x, 0.0), 4.0)
        message = Odometry()
        place, turn = message.pose.pose.position, message.pose.pose.orientation
        place.x, place.y = self.x, self.y
        turn.z, turn.w = math.sin(0.5 * self.psi), math.cos(0.5 * self.psi)
        message.twist.twist.linear.x = self.v
        self.odometry.publish(message)


class Listener(Node):
    """Prints verdicts, one line each."""

    def __init__(self) -> None:
        super().__init__("listener")
        self.create_subscription(String, "/verdict", lambda message: print(message.data), 10)


def main() -> None:
    """Run the node, on a robot or in simulation."""
    parser = argparse.ArgumentParser(description="An exported controller as a ROS 2 node.")
    parser.add_argument("controller", help="folder of `stlc export RUN --to onnx`")
    parser.add_argument("--guard", choices=("none", "paper"), default="none")
    parser.add_argument("--seconds", type=float, default=25.0, help="of simulation")
    given = parser.parse_args()
    controller = Controller.load(given.controller, given.guard)
    if ROS:
        rclpy.init()
        rclpy.spin(ControllerNode(controller))
        return
    Vehicle(controller.facts.dt)
    ControllerNode(controller)
    Listener()
    Node.bus.spin(given.seconds)


if __name__ == "__main__":
    main()
