"""Connect the arm of our plug-in for LeRobot, without an action and then with some; print what it says as JSON."""

import json
import sys
import time

import lerobot_beside_torch  # noqa: F401
from lerobot_robot_bam import BamArm, BamArmConfig, BamKeys, BamKeysConfig

arm = BamArm(BamArmConfig(url=sys.argv[1], units="range", rate=20.0, stage="trial"))
said = {"features": [arm.is_connected, *arm.action_features], "errors": []}


def refused(call, *arguments):
    try:
        call(*arguments)
    except Exception as error:
        said["errors"].append(f"{type(error).__name__}: {error}")


refused(arm.get_observation)
keys = BamKeys(BamKeysConfig())
keys.connect()  # before the arm, as LeRobot does
refused(keys.get_action)
with arm:
    said["before"] = arm.get_observation()
    refused(arm.send_action, {"shoulder_pan.pos": 0.0})
    refused(arm.send_action, {**said["before"], "elbow_flex.pos": float("nan")})
    time.sleep(0.5)
    said["connected"] = arm.get_observation()
    if sys.argv[2] == "moves":
        goal = {**said["before"], "wrist_roll.pos": said["before"]["wrist_roll.pos"] + 10, "gripper.pos": 50.0}
        while max(abs(arm.get_observation()[name] - goal[name]) for name in goal) > 0.5:
            said["sent"] = arm.send_action(goal)
            time.sleep(0.02)
        said["goal"], said["after"] = goal, arm.get_observation()
    if sys.argv[2] != "stays":  # on the way to the end of the range the arm is left, or its link is cut
        away, begun = "wrist_roll.pos", arm.get_observation()["wrist_roll.pos"]
        far = {**arm.get_observation(), away: 95.0}
        try:
            while abs(arm.get_observation()[away] - begun) < 3 or sys.argv[2] == "unplugged":
                arm.send_action(far)
        except Exception as error:
            said["errors"].append(type(error).__name__)
            refused(arm.get_observation)
if sys.argv[2] == "moves":
    with arm:
        said["left"] = [arm.get_observation()]
        time.sleep(0.5)
        said["left"].append(arm.get_observation())
print(json.dumps(said))
