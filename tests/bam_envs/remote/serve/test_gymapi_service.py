"""The GymAPI service, asked by a client that is not ours: bare dicts, without what it may leave out."""

import json
import threading
from dataclasses import replace

import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.wire.transport import spec_from_json
from bam_envs.ros.freshness import Tag
from bam_envs.ros.images import decode_image
from bam_envs.rosbridge.bus import Caller
from bam_envs.testing.transports import MirrorEnv

NAME = "/bam_001/gym_env/gym_api_request"
NONE, STEP, RESET, CLOSE = range(4)
ME, OTHER = Caller("c1", "127.0.0.1:1"), Caller("c2", "127.0.0.1:2")


@pytest.fixture
def serve(bus):
    """A service of an environment on a bus in memory; asks it as a plain client does."""
    made = []

    def start(env, caller=ME, **options):
        server = EnvServer(env, env_id="bam/pick-v0")
        made.append(GymApiService(server, bus, "bam_001", **options).start())
        kind, handler = bus.services[NAME]
        assert kind == "bam_msgs/GymAPI"

        def ask(request_type, caller=caller, seed=None, action=None, env_name=None, **header):
            message = {"header": {"request_type": request_type, **header}}
            given = {"seed": seed, "action": action, "env_name": env_name}
            message |= {key: value for key, value in given.items() if value is not None}
            return handler(json.loads(json.dumps(message)), caller)

        ask.server = server
        return ask

    yield start
    for service in made:
        service.close()
        service.env.close()


def code_of(response):
    return response["header"]["error_code"]["value"]


def refusal(response):
    assert code_of(response) == 2
    return response["header"]["error_msg"]


def test_an_episode_of_a_client_that_says_the_least(serve):
    env = MirrorEnv(spaces.Box(-1, 1, (2,), np.float32), episode_steps=2)
    ask = serve(env)
    begun = ask(RESET)
    assert code_of(begun) == 1
    assert (len(begun["feedback"]), len(begun["feedback"][0]["observation"])) == (1, 2)
    [row] = ask(STEP, action=[{"continuous_action": [0.5, -1]}])["feedback"]
    assert (row["observation"], row["observation_names"]) == ([0.5, -1.0], ["observation[0]", "observation[1]"])
    assert (row["reward"], row["terminated"], row["truncated"], row["executed"]) == (1 / 7, False, False, True)
    info = json.loads(row["info"])
    assert (info["elapsed"], info["text"], info["array"]) == (1, "grün", [0, 1, 2])
    [last] = ask(STEP, action=[{"continuous_action": [0, 0]}])["feedback"]
    assert last["terminated"] is True
    assert code_of(ask(CLOSE)) == 1
    assert [one.tolist() for one in env.seen] == [[0.5, -1.0], [0.0, 0.0]]
    assert env.given == [(None, None)]


def ends(row):
    return row["reward"], row["terminated"], row["truncated"], row["executed"]


def test_a_step_after_the_end_begins_the_next_episode(serve):
    env = MirrorEnv(spaces.Box(-1, 1, (1,), np.float32), episode_steps=1)
    ask = serve(env)
    action = [{"continuous_action": [0.5]}]
    assert refusal(ask(STEP, action=action)).endswith("Call reset() first.")
    ask(RESET, seed=3)
    rows = [ask(STEP, action=action)["feedback"][0] for _ in range(3)]
    assert [ends(row) for row in rows] == [
        (1 / 7, True, False, True),
        (0.0, False, False, False),
        (1 / 7, True, False, True),
    ]
    assert [row["observation"] == [0.5] for row in rows] == [True, False, True]
    assert env.given == [(3, None), (None, None)]
    assert len(env.seen) == 2


def test_a_step_after_the_end_is_refused_to_our_own_clients_and_to_the_next_one(serve):
    env = MirrorEnv(spaces.Discrete(3), episode_steps=1)
    ask = serve(env)
    step = {"action": [{"discrete_action": [1]}]}
    ask(RESET, frame_id=frame_id(1))
    ask(STEP, frame_id=frame_id(2), **step)
    assert refusal(ask(STEP, frame_id=frame_id(3), **step)).endswith("Call reset() first.")
    ask(CLOSE, frame_id=frame_id(4))
    ask(RESET)
    ask(STEP, **step)
    ask(CLOSE)
    assert refusal(ask(STEP, **step)).endswith("Call reset() first.")
    assert refusal(ask(STEP, OTHER, **step)).endswith("Call reset() first.")
    assert len(env.given) == 2
    ask(RESET, seed=7)
    ask(RESET, seed=0)
    ask(RESET, frame_id=" seed=0")
    assert [seed for seed, _ in env.given[2:]] == [7, None, 0]


def test_asked_for_nothing_it_says_what_is_there(serve):
    env = MirrorEnv(spaces.Discrete(3))
    response = serve(env)(NONE)
    spec = spec_from_json(json.loads(response["feedback"][0]["info"])["bam"]["spec"])
    assert (spec.env_id, spec.action_space, spec.num_envs, spec.vector) == ("bam/pick-v0", spaces.Discrete(3), 1, False)
    assert env.given == []


@pytest.mark.parametrize("request_type", [NONE, STEP, RESET])
@pytest.mark.parametrize("name", ["PickAndLift", "CartPole", "bam/pick-place"])
def test_names_that_are_not(serve, name, request_type):
    response = serve(MirrorEnv(spaces.Discrete(3)))(request_type, env_name=name)
    assert refusal(response) == f"There is no environment {name!r} here; bam/pick-v0 is served."


@pytest.mark.parametrize(
    ("action", "text"),
    [
        (None, "A step must have 1 actions, one for each environment, not 0."),
        ([{}, {}], "A step must have 1 actions, one for each environment, not 2."),
        ([{"continuous_action": [1]}], "continuous_action must have 2 values (action[0], action[1]), not 1."),
        ([{"continuous_action": [1, "2"]}], "continuous_action[1]: expected a number, found '2'"),
        ([{"continuous_action": [1, None]}], "continuous_action[1]: expected a number, found None"),
        ([{"discrete_action": [1]}], "continuous_action must have 2 values (action[0], action[1]), not 0."),
        ("go", "action: expected a list, found 'go'"),
    ],
)
def test_actions_that_do_not_fit_move_nothing(serve, action, text):
    env = MirrorEnv(spaces.Box(-1, 1, (2,), np.float32))
    ask = serve(env)
    ask(RESET)
    assert text in refusal(ask(STEP, action=action))
    assert env.seen == []
    assert code_of(ask(STEP, action=[{"continuous_action": [1, 1]}])) == 1


def test_one_client_is_in_command(serve):
    env = MirrorEnv(spaces.Discrete(3))
    ask = serve(env)
    step = {"action": [{"discrete_action": [1]}]}
    assert code_of(ask(RESET, client_id="ann")) == 1
    refused = ask(RESET, OTHER, client_id="bob")
    assert refusal(refused).startswith("ann (127.0.0.1:1) is in command, not bob (127.0.0.1:2);")
    assert "ann (127.0.0.1:1) is in command" in refusal(ask(STEP, OTHER, client_id="bob", **step))
    text = refusal(ask(RESET, OTHER, client_id="bob", force_priority=True))
    assert text.endswith(
        "Taking it by force needs the operator's token: start bam-serve with --operator-token-file, and show that one."
    )
    operator = replace(OTHER, operator=True)
    assert code_of(ask(RESET, operator, client_id="bob", force_priority=True)) == 1
    assert "bob (127.0.0.1:2) is in command" in refusal(ask(STEP, client_id="ann", **step))
    assert code_of(ask(STEP, OTHER, client_id="bob", **step)) == 1
    assert code_of(ask(CLOSE, OTHER, client_id="bob")) == 1
    assert code_of(ask(RESET, client_id="a" * 1000, frame_id=frame_id(1))) == 1
    text = refusal(ask(RESET, OTHER))
    assert text.startswith(f"{'a' * 100} (127.0.0.1:1) is in command, not somebody (127.0.0.1:2);")
    for kind in (RESET, STEP):  # nobody is told the session of another: it is the proof of who made it
        assert "abc" not in json.dumps(ask(kind, OTHER, client_id="bob", **step))


def test_who_is_back_on_another_connection_stays_in_command(serve, bus):
    ask = serve(MirrorEnv(spaces.Discrete(3)))
    assert code_of(ask(RESET, ME, client_id="ann", frame_id=frame_id(1))) == 1
    assert code_of(ask(RESET, OTHER, client_id="ann", frame_id=frame_id(2, epoch=2))) == 1
    gone = threading.Event()
    ask.server.lease.on_change(lambda before, after: gone.set())
    bus.leave("c1")
    step = {"frame_id": frame_id(3, epoch=2), "client_id": "ann", "action": [{"discrete_action": [1]}]}
    assert code_of(ask(STEP, OTHER, **step)) == 1
    assert not gone.is_set()
    bus.leave("c2")
    assert gone.wait(10)


def frame_id(sequence, epoch=1, sent=1000.0, lifetime=5.0):
    return Tag("abc", epoch, sequence, sent, sent + lifetime).to_text()


def test_old_requests_are_refused(serve):
    env = MirrorEnv(spaces.Discrete(3))
    ask = serve(env)
    step = {"action": [{"discrete_action": [1]}]}
    ask(RESET, frame_id=frame_id(5))
    for number in (4, 5):  # 5 came before
        assert refusal(ask(STEP, frame_id=frame_id(number), **step)) == f"old message: number {number} after number 5"
    ask(NONE, frame_id=frame_id(6, epoch=2))
    assert refusal(ask(STEP, frame_id=frame_id(7), **step)) == "old connection: epoch 1, and epoch 2 is there"
    late = ask(STEP, frame_id=frame_id(8, epoch=2, sent=900.0), **step)
    assert "after its deadline" in refusal(late)
    assert env.seen == []


def test_rows_are_one_request(serve):
    makers = [lambda: MirrorEnv(spaces.Box(-1, 1, (1,), np.float32), episode_steps=2)] * 3
    ask = serve(SyncVectorEnv(makers, autoreset_mode=AutoresetMode.SAME_STEP))
    assert len(ask(RESET, seed=1)["feedback"]) == 3
    actions = [{"continuous_action": [value]} for value in (0, 0.5, 1)]
    first = ask(STEP, action=actions)["feedback"]
    assert [row["observation"] for row in first] == [[0.0], [0.5], [1.0]]
    second = ask(STEP, action=actions)["feedback"]
    assert [row["terminated"] for row in second] == [True] * 3
    assert [json.loads(row["info"])["final_obs"] for row in second] == [[0.0], [0.5], [1.0]]
    assert refusal(ask(STEP, action=actions[:2])) == "A step must have 3 actions, one for each environment, not 2."


def test_pictures_and_stamps(serve, bus):
    bus.stamp = lambda t: {"secs": int(t), "nsecs": 0}
    ask = serve(MirrorEnv(spaces.Box(0, 255, (8, 12, 3), np.uint8)), clock=lambda: 77.0)
    [image] = ask(RESET)["feedback"][0]["color_img"]
    assert image["format"] == "png"
    assert image["header"] == {"stamp": {"secs": 77, "nsecs": 0}, "frame_id": "observation"}
    assert decode_image(image["data"]).shape == (8, 12, 3)
