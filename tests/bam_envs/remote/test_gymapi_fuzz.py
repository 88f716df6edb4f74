"""Whatever comes, what leaves is an answer or an error of ours."""

import json
from contextlib import suppress

from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from bam_envs.core.errors import BamEnvsError
from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.gymapi_service import GymApiService
from bam_envs.remote.wire.gymapi_codec import EnvCodec
from bam_envs.remote.wire.gymapi_messages import read_response
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.remote.wire.values import exact
from bam_envs.rosbridge.bus import UNKNOWN_CALLER
from bam_envs.testing.transports import MirrorEnv

WORDS = st.sampled_from(
    ["", "bam:", "bam:{}", 'bam:{"action":1}', "bam1 s=a e=1 q=1 t=1 d=2", " seed=0", "{}", "[", "é"]
)
JSON = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**70), 2**70) | st.floats() | WORDS | st.text(max_size=4),
    lambda inside: st.lists(inside, max_size=3) | st.dictionaries(st.text(max_size=3), inside, max_size=3),
    max_leaves=5,
)


@st.composite
def near(draw, **fields):
    """A mapping of most of the `fields`, each nearly always of its kind."""
    chances = {name: draw(st.integers(0, 39)) for name in fields}
    return {name: draw(JSON if chances[name] == 1 else kind) for name, kind in fields.items() if chances[name] > 0}


NUMBERS = st.lists(st.floats(-1, 1), min_size=2, max_size=2) | st.lists(JSON, max_size=3)
INFO = st.sampled_from(
    ['{"bam": {"observation": {"state": 3}}}', '{"bam": {"info": {"a": {"array": [1]}}}}', '{"bam": 1}']
)
POSE = near(pose=near(position=near(x=st.floats(-1, 1)), orientation=near(w=st.floats(-1, 1))))
ACTION = near(
    prefix=WORDS,
    continuous_action=NUMBERS,
    continuous_names=st.lists(st.sampled_from(["state[0]", "state[1]", "z"]), max_size=3),
    discrete_action=st.lists(st.integers(-1, 4), max_size=2),
    pose_action=st.lists(POSE, max_size=2),
)
REQUEST = near(
    header=near(request_type=st.integers(0, 4), frame_id=WORDS, client_id=st.sampled_from("ab")),
    seed=st.integers(-1, 3),
    env_name=st.sampled_from(["", "Mirror", "Pick"]),
    action=st.lists(ACTION, max_size=2),
)
IMAGE = near(format=st.just("png"), data=st.sampled_from(["", "iVBORw0KGgo=", "//8=", "x"]))
FEEDBACK = near(
    observation=NUMBERS,
    observation_names=st.lists(st.sampled_from(["state[0]", "state[1]"]), max_size=3),
    pose=st.lists(POSE, max_size=1),
    color_img=IMAGE | st.lists(IMAGE, max_size=2),
    depth_img=near(data=st.sampled_from(["", "AAAA"]), height=st.integers(0, 3), encoding=st.just("16UC1")),
    reward=st.floats(-9, 9),
    info=INFO | st.text(max_size=5),
    duplicate_obs_ns=st.booleans(),
)
RESPONSE = near(
    header=near(error_code=near(value=st.sampled_from([1, 1, 1, 2])), error_msg=st.text(max_size=3)),
    feedback=st.lists(FEEDBACK, min_size=1, max_size=1) | st.lists(FEEDBACK, max_size=2),
)
STATE = spaces.Box(-1, 1, (2,))
SPACES = [
    spaces.Dict(state=STATE, mode=spaces.Discrete(3)),
    spaces.Dict(state=STATE, camera=spaces.Box(0, 255, (8, 8, 3), "uint8"), depth=spaces.Box(0, 9, (8, 8))),
    spaces.Dict(position=spaces.Box(-1, 1, (3,)), orientation=spaces.Box(-1, 1, (4,))),
    spaces.Text(5),
]


class NoBus:
    """Nobody is there."""

    stamp = staticmethod(lambda t: {"sec": int(t), "nanosec": 0})


SERVICES = [GymApiService(EnvServer(MirrorEnv(space), env_id="Mirror"), NoBus()) for space in SPACES]


@given(st.sampled_from(SERVICES), REQUEST | JSON)
def test_every_request_is_answered(service, request):
    response = service.handle(request, UNKNOWN_CALLER)
    header = response["header"]
    assert header["error_code"]["value"] in (1, 2)
    assert (header["error_code"]["value"] == 2) == bool(header["error_msg"])
    json.dumps(response, allow_nan=False, default=lambda data: data.hex())


@given(st.sampled_from(SPACES), RESPONSE | JSON)
def test_every_response_is_read_or_refused(space, message):
    codec = EnvCodec(EnvSpecMessage("x", space, spaces.Discrete(2)))
    with suppress(BamEnvsError):
        exact(space, codec.read_result(read_response(message))[0])
