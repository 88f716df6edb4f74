"""Racks that are not ours, behind the embedded rosbridge server."""

import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.errors import InvalidValue, NoServer, ProtocolError, RemoteError
from bam_envs.remote.remote_vector_env import RemoteVectorEnv
from bam_envs.ros.images import encode_image
from tests.raising import raising

CAMERA = spaces.Box(0, 255, (8, 12, 3), np.uint8)
SEEN = spaces.Dict(camera=CAMERA, state=spaces.Box(-10, 10, (2,), np.float64))
POSE = {"position": spaces.Box(-2, 2, (3,)), "orientation": spaces.Box(-1, 1, (4,))}
PICK = spaces.Dict(pick=spaces.Dict({**POSE, "gripper_width": spaces.Box(0, 0.1, ())}))
UPRIGHT = {"position": np.float32([0.5, 0, 0.25]), "orientation": np.float32([0, 1, 0, 0])}
ACTION = {"pick": {**UPRIGHT, "gripper_width": np.float32(0.0625)}}


class Rack:
    """A BAM rack as its own people wrote it: it knows no tags and no descriptions, and one environment by its class."""

    def __init__(self, arms=1, images=1):
        self.arms, self.images, self.requests = arms, images, []
        self.picture = np.random.default_rng(2).integers(0, 256, CAMERA.shape, dtype=np.uint8)

    def answer(self, request, caller):
        self.requests.append(request)
        kind = request["header"]["request_type"]
        if kind == 0:
            return self.response(2, "Unsupported request type", [])
        if kind == 3:
            return self.response(1, "", [])
        if request["env_name"] != "Pick":
            return self.response(2, f"Unknown environment: {request['env_name']}", [])
        if kind == 2:
            return self.response(1, "", [self.feedback(0.0) for _ in range(self.arms)])
        return self.response(1, "", [self.stepped(one) for one in request["action"]])

    def stepped(self, action):
        assert (action["action_type"], action["pose_names"], action["prefix"]) == (2, ["pick"], "")
        height = action["pose_action"][0]["pose"]["position"]["z"]
        done = {"reward": 1.0, "terminated": height < 0.5, "executed": True, "info": '{"grasp": "ok"}'}
        return {**self.feedback(height), **done}

    def feedback(self, height):
        image = {"format": "jpeg" if self.images > 1 else "png", "data": encode_image(self.picture)}
        return {
            "observation_names": ["z", "width"],
            "observation": [height, 0.5],
            "color_img": image if self.images == 1 else [image] * self.images,
        }

    def response(self, code, text, feedback):
        header = {"duration": 0.5, "error_code": {"value": code}, "error_msg": text, "calibrated": True}
        return {"header": header, "feedback": feedback}


@pytest.fixture
def rack(server):
    """A rack behind the server."""

    def start(**options):
        made = Rack(**options)
        server.serve("/bam_001/gym_env/gym_api_request", "bam_msgs/GymAPI", made.answer)
        return made

    return start


PICKING = {"env_id": "Pick", "observation_space": SEEN, "action_space": PICK, "action_type": 2}


@pytest.mark.parametrize("images", [1, 2])
def test_a_real_rack(rack, open_to, images):
    there = rack(images=images)
    transport = open_to(**PICKING, name="lab")
    spec = transport.connect()
    assert (spec.env_id, spec.num_envs, spec.vector, spec.action_space) == ("Pick", 1, False, PICK)
    observation, info = transport.reset(seed=3)
    assert observation["state"].tolist() == [0.0, 0.5]
    np.testing.assert_array_equal(observation["camera"], there.picture)
    assert info == {"executed": False}
    observation, reward, terminated, truncated, info = transport.step(ACTION)
    assert observation["state"].tolist() == [0.25, 0.5]
    assert (reward, terminated, truncated, info) == (1.0, True, False, {"grasp": "ok", "executed": True})
    reset, step = there.requests
    assert (reset["seed"], reset["env_name"], reset["action"]) == (3, "Pick", [])
    header = step["header"]
    assert (header["client_id"], header["request_type"], header["frame_id"]) == ("lab", 1, "")
    assert step["action"][0]["pose_param"][0]["gripper_width"] == 0.0625
    assert step["action"][0]["pose_param"][0]["planner"] == "ptp"
    transport.close()
    assert [one["header"]["request_type"] for one in there.requests] == [2, 1, 3]


def heights(*numbers):
    """The actions of as many arms."""
    rows = [{**UPRIGHT, "position": np.float32([0.5, 0, z]), "gripper_width": np.float32(0)} for z in numbers]
    return {"pick": {key: np.stack([row[key] for row in rows]) for key in rows[0]}}


@pytest.fixture
def arms(rack, open_to):
    """Two arms of a rack as rows, and the rack."""
    there = rack(arms=2)
    return RemoteVectorEnv(open_to(**PICKING, num_envs=2)), there


def test_the_episode_of_one_arm_ends_those_of_the_others(arms):
    envs, there = arms
    envs.reset()
    observation, reward, terminated, truncated, infos = envs.step(heights(0.75, 1.0))
    assert (terminated.tolist(), truncated.tolist()) == ([False, False], [False, False])
    assert observation["state"][:, 0].tolist() == [0.75, 1.0]
    assert "final_obs" not in infos
    observation, reward, terminated, truncated, infos = envs.step(heights(0.25, 0.75))
    assert reward.tolist() == [1.0, 1.0]
    assert (terminated.tolist(), truncated.tolist()) == ([True, False], [False, True])
    assert observation["state"][:, 0].tolist() == [0.0, 0.0]
    assert [row["state"][0] for row in infos["final_obs"]] == [0.25, 0.75]
    assert infos["final_info"]["grasp"].tolist() == ["ok", "ok"]
    assert infos["executed"].tolist() == [False, False]
    assert [one["header"]["request_type"] for one in there.requests] == [2, 1, 1, 2]


@pytest.mark.parametrize(("seed", "sent"), [(5, 5), ([5, 6], 5), (None, 0)])
def test_the_arms_of_a_rack_have_one_seed(arms, seed, sent):
    envs, there = arms
    envs.reset(seed=seed)
    assert [one["seed"] for one in there.requests] == [sent]


@pytest.mark.parametrize("seed", [[5, 5], [5, None], [None, 6]])
def test_other_seeds_of_its_arms_are_refused(arms, seed):
    envs, there = arms
    with raising(
        InvalidValue,
        f"The 2 environments of Pick begin together, from one seed s that stands for s, s + 1, …; not from {seed}.",
    ):
        envs.reset(seed=seed)
    assert there.requests == []
    envs.reset()
    with raising(InvalidValue, "The 2 environments of Pick begin together; reset_mask must hold all of them or none."):
        envs.reset(options={"reset_mask": np.array([True, False])})
    assert len(there.requests) == 1


def test_what_a_rack_does_not_understand_is_not_sent(rack, open_to):
    there = rack()
    transport = open_to(**PICKING)
    transport.connect()
    with pytest.raises(InvalidValue, match="The seed must be a whole number from 1 to 2147483647 or None, not 0"):
        transport.reset(seed=0)
    with pytest.raises(InvalidValue, match="GymAPI has no field for options of reset"):
        transport.reset(options={"a": 1})
    assert there.requests == []


def test_a_rack_without_that_environment_with_more_arms_or_without_spaces(rack, open_to):
    there = rack()
    with pytest.raises(RemoteError, match=r"^Unknown environment: FoldShirt$"):
        open_to(**{**PICKING, "env_id": "FoldShirt"}).reset()
    there.arms = 2
    with pytest.raises(ProtocolError, match="The response must have 1 feedback, one for each environment, not 2"):
        open_to(**PICKING).reset()
    with pytest.raises(NoServer) as error:
        open_to(env_id="Pick").connect()
    assert str(error.value).endswith(
        "/bam_001/gym_env/gym_api_request: Unsupported request type; give observation_space and action_space, or an "
        "env_id that is registered here. Start one: bam-serve --env Pick --namespace bam_001"
    )
