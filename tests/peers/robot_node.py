"""A UR5e as a ROS 2 node, in rclpy alone: publishes its state at 100 Hz, follows commands, holds when they stop.

It shares no code with the project. Ready, it prints one line; a line on its standard input is answered by one line of
JSON: ``report`` for what it received, ``forget`` to begin a new report, ``pause`` and ``play`` for its program,
``stop`` to end. Numbers that are not finite are written as text.
"""

import contextlib
import json
import math
import sys
import threading
import time

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Empty, Float64MultiArray, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

PERIOD = 0.01
COMMAND_TIMEOUT = 0.1
MAX_SPEED = math.pi
MAX_GRIPPER_SPEED = 0.2
# Commands that wait for this node; so many that its report lacks none.
KEPT = 1000
JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
# Other than alphabetical and other than the arm's order, as real drivers publish them.
PUBLISHED = (2, 1, 0, 3, 4, 5)
HOME = (0.0, -1.5708, 1.5708, -1.5708, -1.5708, 0.0)


def approach(value, target, step):
    return value + max(-step, min(step, target - value))


def plain(number):
    return number if math.isfinite(number) else repr(number)


class Robot:
    def __init__(self, node):
        self.node, self.lock = node, threading.Lock()
        self.position, self.velocity = list(HOME), [0.0] * 6
        self.target, self.gripper, self.gripper_target = list(HOME), 0.085, 0.085
        self.commanded_at, self.reached_at, self.received, self.holds, self.halts = 0.0, 0.0, [], 0, 0
        self.joint_states = node.create_publisher(JointState, "/joint_states", 10)
        self.gripper_states = node.create_publisher(JointState, "/gripper/joint_states", 10)
        self.objects = node.create_publisher(PoseStamped, "/object_pose", 10)
        kept = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self.running = node.create_publisher(Bool, "/io_and_status_controller/robot_program_running", kept)
        self.running.publish(Bool(data=True))
        self.pong = node.create_publisher(String, "/pong", 10)
        for kind, topic, callback in (
            (Float64MultiArray, "/forward_position_controller/commands", self.on_positions),
            (JointTrajectory, "/scaled_joint_trajectory_controller/joint_trajectory", self.on_trajectory),
            (Float64MultiArray, "/gripper/commands", self.on_gripper),
            (Empty, "/bam/halt", self.on_halt),
            (String, "/ping", self.pong.publish),
        ):
            node.create_subscription(kind, topic, callback, KEPT)
        node.create_service(SetBool, "/robot/set", self.on_set)
        node.create_service(Trigger, "/robot/slow", self.on_slow)
        node.create_timer(PERIOD, self.tick)

    def record(self, topic, values):
        with self.lock:
            self.received.append({"topic": topic, "values": [plain(value) for value in values], "at": time.time()})

    def on_positions(self, message):
        self.record("positions", message.data)
        self.move(message.data)

    def on_trajectory(self, message):
        last = message.points[-1].positions if message.points else []
        self.record("trajectory", last)
        if sorted(message.joint_names) == sorted(JOINTS):
            reach = message.points[-1].time_from_start
            seconds = reach.sec + 1e-9 * reach.nanosec
            self.move([last[message.joint_names.index(joint)] for joint in JOINTS], seconds)

    def move(self, positions, seconds=0.0):
        """Go to `positions` in so many seconds, as a trajectory controller does, or at once."""
        if len(positions) == len(JOINTS) and all(map(math.isfinite, positions)):
            self.target, self.commanded_at = list(positions), time.monotonic()
            self.reached_at = self.commanded_at + seconds

    def on_gripper(self, message):
        self.record("gripper", message.data)
        if len(message.data) == 1 and math.isfinite(message.data[0]):
            self.gripper_target = message.data[0]

    def on_halt(self, _):
        self.halts += 1
        self.target, self.gripper_target = list(self.position), self.gripper

    def on_set(self, request, response):
        response.success, response.message = request.data, "set" if request.data else "not set"
        return response

    def on_slow(self, _, response):
        time.sleep(1.0)
        response.success = True
        return response

    def tick(self):
        if self.target != self.position and time.monotonic() - self.commanded_at > COMMAND_TIMEOUT:
            self.holds += 1
            self.target, self.gripper_target = list(self.position), self.gripper
        before, share = self.position, min(1.0, PERIOD / max(self.reached_at - time.monotonic(), PERIOD))
        goals = [old + (goal - old) * share for old, goal in zip(before, self.target, strict=True)]
        moved = [approach(*pair, MAX_SPEED * PERIOD) for pair in zip(before, goals, strict=True)]
        self.velocity = [(new - old) / PERIOD for new, old in zip(moved, before, strict=True)]
        self.position = moved
        self.gripper = approach(self.gripper, self.gripper_target, MAX_GRIPPER_SPEED * PERIOD)
        self.publish()

    def publish(self):
        joints, fingers, cube = JointState(), JointState(), PoseStamped()
        stamp = self.node.get_clock().now().to_msg()
        for message in (joints, fingers, cube):
            message.header.stamp = stamp
        joints.name = [JOINTS[i] for i in PUBLISHED]
        joints.position = [self.position[i] for i in PUBLISHED]
        joints.velocity = [self.velocity[i] for i in PUBLISHED]
        fingers.name, fingers.position = ["gripper_width"], [self.gripper]
        cube.header.frame_id = "base_link"
        cube.pose.position.x, cube.pose.position.y, cube.pose.position.z = 0.5, 0.1, 0.02
        cube.pose.orientation.w = 1.0
        self.joint_states.publish(joints)
        self.gripper_states.publish(fingers)
        self.objects.publish(cube)

    def report(self):
        with self.lock:
            return {
                "received": list(self.received),
                "position": self.position,
                "gripper": self.gripper,
                "holds": self.holds,
                "halts": self.halts,
            }

    def forget(self):
        with self.lock:
            self.received, self.holds, self.halts = [], 0, 0
        return {}

    def pause(self):
        self.running.publish(Bool(data=False))
        return {}

    def play(self):
        self.running.publish(Bool(data=True))
        return {}


def spin(executor):
    with contextlib.suppress(ExternalShutdownException):
        executor.spin()


def main():
    rclpy.init()
    node = rclpy.create_node("ur5e")
    robot = Robot(node)
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    controller = rclpy.create_node("forward_position_controller")  # whose parameters say in which order it takes joints
    controller.declare_parameter("joints", list(JOINTS))
    executor.add_node(controller)
    thread = threading.Thread(target=spin, args=(executor,), daemon=True)
    thread.start()
    print("ready", flush=True)
    for line in sys.stdin:
        if line.strip() == "stop":
            break
        print(json.dumps(getattr(robot, line.strip())()), flush=True)
    executor.shutdown()
    rclpy.try_shutdown()
    thread.join(timeout=5)


main()
