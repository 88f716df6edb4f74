"""What others speak: the compiled types of bam_msgs/GymAPI, a client and a rack, in each of its versions.

Written from the table of versions, without the project's code: a client parses as strictly as the originals, and a
compiled type refuses a field that it lacks.
"""

import base64
import copy
import json

import numpy as np

from bam_envs.core.errors import RemoteError
from bam_envs.ros.images import decode_image, encode_image

MAY_24, JUNE_17, JUNE_22 = VERSIONS = ("2025-05-24", "2025-06-17", "2025-06-22")
NONE, STEP, RESET, CLOSE = range(4)

TIME = {"sec": 0, "nanosec": 0}
HEADER = {"stamp": TIME, "frame_id": ""}
POSE = {
    "header": HEADER,
    "pose": {"position": dict.fromkeys("xyz", 0.0), "orientation": {**dict.fromkeys("xyz", 0.0), "w": 1.0}},
}
COLOR = {"header": HEADER, "format": "", "data": ""}
DEPTH = {"header": HEADER, "height": 0, "width": 0, "encoding": "", "is_bigendian": 0, "step": 0, "data": ""}
CAMERA = {"header": HEADER, "height": 0, "width": 0, "d": [0.0], "k": [0.0] * 9}
WAYPOINT = {
    **dict.fromkeys(("kp_scale", "kd_scale", "max_velocity", "max_effort", "vel_scale", "accel_scale"), 0.0),
    **dict.fromkeys(("blend_radius", "goal_tol", "path_tol", "vertical_angle_scale", "gripper_width"), 0.0),
    **dict.fromkeys(("target_link", "planner"), ""),
}
ACTION = {
    "action_type": 0,
    "ns": "",
    "prefix": "",
    "rank": 0,
    "target_class": [0],
    "discrete_names": [""],
    "discrete_action": [0],
    "continuous_names": [""],
    "continuous_action": [0.0],
    "pose_names": [""],
    "pose_action": [POSE],
    "pose_param": [WAYPOINT],
}
"""A type is a dict of its fields, a list of one type, or the default of a plain value."""


def request_type(version):
    busy = "force_if_busy" if version == MAY_24 else "force_busy"
    flags = dict.fromkeys((busy, "force_uncalibrated", "force_priority", "blocking", "clear_priority"), False)
    header = {
        "client_id": "",
        "request_type": 0,
        "stamp": TIME,
        "frame_id": "",
        "expected_duration": 0.0,
        "priority": 0,
    }
    return {"header": {**header, **flags}, "seed": 0, "env_name": "", "action": [ACTION]}


def response_type(version):
    june = {"process_duration": 0.0, "transport_duration": 0.0, "response_stamp": TIME}
    times = {"duration": 0.0} if version == MAY_24 else june
    header = {**times, "error_code": {"value": 0}, "error_msg": "", "calibrated": False}
    images = {"color_img": COLOR, "depth_img": DEPTH, "camera_info": CAMERA}
    if version == JUNE_22:
        images = {name: [one] for name, one in images.items()}
    seen = {"segments": [{}]} if version == JUNE_22 else {"detections": [{}], "masks": [{}]}
    same = {"duplicate_obs_ns": False} if version == MAY_24 else {"duplicate_obs": False, "duplicate_index": 0}
    lists = {"observation_names": [""], "observation": [0.0], "pose_names": [""], "pose": [POSE], "target_class": [0]}
    ends = {"executed": False, "reward": 0.0, "terminated": False, "truncated": False, "info": ""}
    return {"header": header, "feedback": [{"ns": "", **lists, **images, **seen, **same, **ends}]}


def compiled(kind, value, path="GymAPI"):
    """`value` as a message of the compiled type `kind`, complete; a field that it lacks is refused."""
    if isinstance(kind, dict):
        if not isinstance(value, dict):
            raise RemoteError(f"{path}: expected a message, found {value!r}")
        if unknown := value.keys() - kind.keys():
            raise RemoteError(f"Message type {path} does not have a field {sorted(unknown)[0]}")
        return {name: compiled(one, value.get(name, empty(one)), f"{path}.{name}") for name, one in kind.items()}
    if isinstance(kind, list):
        if not isinstance(value, list):
            raise RemoteError(f"{path}: expected a list, found {value!r}")
        return [compiled(kind[0], one, path) for one in value]
    return value


def empty(kind):
    return [] if isinstance(kind, list) else {} if isinstance(kind, dict) else kind


def on_the_wire(message):
    return json.loads(json.dumps(message, default=lambda data: base64.b64encode(data).decode()))


class Client:
    """A client that never resets between episodes.

    Args:
        version: Which it speaks.
        call: Carries a request, and returns the response.
    """

    def __init__(self, version, call):
        self.version, self.call = version, call

    def ask(self, request_type_, action=(), **fields):
        """The rows of the answer as it understands them."""
        message = compiled(request_type(self.version), {"action": list(action), "env_name": "Pick", **fields})
        message["header"] |= {"request_type": request_type_, "client_id": "bam_gym"}
        answer = self.call(on_the_wire(message))
        header = answer["header"]
        assert header["error_code"]["value"] == 1, header["error_msg"]
        self.took = header["duration" if self.version == MAY_24 else "process_duration"]
        self.stamp = None if self.version == MAY_24 else header["response_stamp"]["sec"]
        return [self.row(one) for one in answer["feedback"]]

    def row(self, feedback):
        if self.version == JUNE_22:
            images = [self.image(one) for one in feedback.get("color_img", [])]
            assert [one.get("k") for one in feedback.get("camera_info", [])] == []
            assert feedback.get("segments", []) == []
        else:
            images = [self.image(feedback["color_img"])]
            assert feedback["camera_info"].get("height") == 0
            assert (feedback.get("detections", []), feedback.get("masks", [])) == ([], [])
        ends = [feedback[name] for name in ("reward", "terminated", "truncated", "executed")]
        return feedback["observation"], [one for one in images if one is not None], *ends

    def image(self, message):
        data = base64.b64decode(message.get("data", ""))
        return decode_image(data) if data else None


class Rack:
    """A rack with two arms that see the same, by one camera; each action says what they see next.

    Args:
        version: Which it speaks. Those of June begin the next episode in the step that ends one.
        ends_at: What ends an episode when it is seen.
    """

    def __init__(self, version, arms=2, ends_at=0.75):
        self.version, self.arms, self.ends_at, self.requests = version, arms, ends_at, []
        self.picture = np.arange(8 * 12 * 3, dtype=np.uint8).reshape(8, 12, 3)

    def answer(self, request, caller=None):
        """The response to a request as its compiled type makes it."""
        request = copy.deepcopy(request)
        self.requests.append(request)
        kind = request["header"]["request_type"]
        if kind == NONE:
            return self.response(2, "Unsupported request type", [])
        if kind == CLOSE:
            return self.response(1, "", [])
        seen = [0.0] * self.arms if kind == RESET else [one["continuous_action"][0] for one in request["action"]]
        return self.response(1, "", [self.feedback(arm, seen, kind) for arm in range(self.arms)])

    def feedback(self, arm, seen, kind):
        ended = kind == STEP and seen[arm] == self.ends_at
        shown = 0.0 if ended and self.version != MAY_24 else seen[arm]
        row = {"ns": "rack", "reward": seen[arm], "terminated": ended, "executed": kind == STEP}
        if arm and seen[arm] == seen[0]:
            same = {"duplicate_obs_ns": True} if self.version == MAY_24 else {"duplicate_obs": True}
            return {**row, **same}
        image = {"format": "png", "data": encode_image(self.picture)}
        return {**row, "observation": [shown], "color_img": [image] if self.version == JUNE_22 else image}

    def response(self, code, text, feedback):
        times = {"duration": 0.5} if self.version == MAY_24 else {"process_duration": 0.5}
        return {"header": {**times, "error_code": {"value": code}, "error_msg": text}, "feedback": feedback}
