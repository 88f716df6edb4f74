"""Whatever clients send, the server goes on, and forgets it."""

import contextlib
import copy
import json
import math
import random

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from bam_envs.rosbridge.bus import Caller
from bam_envs.rosbridge.server import BridgeServer
from bam_envs.rosbridge.server.bridge import Bridge
from bam_envs.rosbridge.server.client_session import Send

COMMAND, TRIGGER = "std_msgs/Float64MultiArray", "std_srvs/Trigger"
SEEDS = [
    {"op": "advertise", "topic": "/a", "type": "std_msgs/String", "id": "1", "latch": True},
    {"op": "unadvertise", "topic": "/a", "id": "1"},
    {"op": "publish", "topic": "/a", "msg": {"data": "é"}},
    {"op": "publish", "topic": "/command", "msg": {"layout": {"dim": [{"label": "x"}]}, "data": [1, 2.5, -3e5]}},
    {"op": "subscribe", "topic": "/a", "type": "std_msgs/msg/String", "id": 2, "throttle_rate": 5, "queue_length": 2},
    {"op": "subscribe", "topic": "/command", "type": COMMAND, "compression": "cbor"},
    {"op": "subscribe", "topic": "/a", "type": "std_msgs/String", "compression": "png", "fragment_size": 20},
    {"op": "unsubscribe", "topic": "/a", "id": 2},
    {"op": "advertise", "topic": "/j", "type": "sensor_msgs/JointState"},
    {"op": "publish", "topic": "/j", "msg": {"header": {"stamp": {"secs": 1}}, "name": ["a"], "position": [0.5]}},
    {"op": "publish", "topic": "/i", "msg": {"data": "AAAA", "format": "jpeg"}},
    {"op": "call_service", "service": "/trigger", "id": "c", "args": {}, "timeout": 0.5},
    {"op": "call_service", "service": "/rosapi/topic_type", "args": ["/a"]},
    {"op": "call_service", "service": "/mine", "args": {"data": True}, "fragment_size": 30},
    {"op": "advertise_service", "service": "/mine", "type": "std_srvs/SetBool"},
    {"op": "unadvertise_service", "service": "/mine"},
    {"op": "service_response", "service": "/mine", "id": "7", "values": {"success": True}, "result": True},
    {"op": "set_level", "level": "info"},
    {"op": "fragment", "id": "f", "data": '{"op": "set_le', "num": 0, "total": 2},
    {"op": "fragment", "id": "f", "data": 'vel", "level": "error"}', "num": 1, "total": 2},
    {"op": "send_action_goal", "action": "/a", "id": 1},
    {"op": "auth", "mac": "x"},
]
STRANGE = [
    *(None, True, False, "", "300", "/a", "a b", "\ud800", "\x00", "x" * 300),
    *(0, -1, 1e308, -1e308, 2**31, 2**63, 2**64, 10**30, math.nan, math.inf, 33.3),
    *([], {}, [[]], [None], [math.nan], [1, "2", None], {"data": None}, {"a": {"b": {"c": []}}}),
]


def receive(bridge, session, frame, now):
    """Do what a frame of a client says, as a server does."""
    text = bridge.take(session, bridge.read(frame), now)
    if text is not None:
        bridge.take(session, bridge.read(text, joined=True), now)


class Refuses:
    """The listener of the robot: nothing but finite numbers may come here."""

    heard = 0

    def __call__(self, message, caller):
        self.heard += 1
        assert all(type(value) is float and math.isfinite(value) for value in message["data"])


def mutated(dice):
    """One frame: of a message that is right, or no longer."""
    message = json.loads(json.dumps(dice.choice(SEEDS)))
    for _ in range(dice.choice((0, 1, 1, 2, 5))):
        change(message, dice)
    text = json.dumps(message)
    kind = dice.random()
    if kind < 0.15:
        return scratched(text.encode(), dice)
    if kind < 0.2:
        return dice.randbytes(dice.randrange(64))
    if kind < 0.23:
        return text + json.dumps(dice.choice(SEEDS))
    if kind < 0.24:
        return "[" * dice.randrange(2000) + text
    return text if kind < 0.9 else text.encode()


def change(message, dice):
    """Change something in it, deep or not."""
    place = message
    while isinstance(place, (dict, list)) and place:
        key = dice.choice(list(place)) if isinstance(place, dict) else dice.randrange(len(place))
        inside = place[key]
        if not isinstance(inside, (dict, list)) or not inside or dice.random() < 0.4:
            break
        place = inside
    else:
        return
    what = dice.random()
    if what < 0.6:
        place[key] = copy.deepcopy(dice.choice(STRANGE))  # it may be changed in its turn
    elif what < 0.7 and isinstance(place, dict):
        place[f"/n{dice.randrange(3000)}"] = place.pop(key)
    elif what < 0.85 and isinstance(inside, str):
        place[key] = inside + str(dice.randrange(3000))
    else:
        del place[key]


def scratched(data, dice):
    """Bytes with some of them changed, left out or repeated."""
    data = bytearray(data)
    for _ in range(dice.randrange(1, 5)):
        at = dice.randrange(len(data) + 1)
        data[at : at + dice.randrange(3)] = dice.randbytes(dice.randrange(3))
    return bytes(data) or b"{"


class Fuzzed:
    """A bridge among clients that send nonsense; each stays for a while."""

    def __init__(self, seed):
        self.dice, self.now, self.frames, self.robot = random.Random(seed), 0.0, 0, Refuses()
        self.bridge = Bridge(clock=lambda: self.now)
        self.bridge.subscribe("/command", COMMAND, self.robot)
        self.bridge.serve("/trigger", TRIGGER, lambda request, caller: {"success": True})
        self.sessions = [self.bridge.open(Caller("fuzz")) for _ in range(4)]

    def run(self, count):
        for number in range(count):
            self.now += 0.001
            place = self.dice.randrange(len(self.sessions))
            if self.dice.random() < 1 / 2000:
                self.bridge.lost(self.sessions[place])
                self.sessions[place] = self.bridge.open(Caller("fuzz"))
            receive(self.bridge, self.sessions[place], mutated(self.dice), self.now)
            self.settle()
            if number % 1000 == 0:
                self.require_service()

    def settle(self):
        """What a server does between two frames."""
        while events := self.bridge.events():
            for event in events:
                if isinstance(event, Send):
                    self.frames += len(event.packet.frames)
                else:
                    self.bridge.services.finish(event, self.bridge.services.packed_answer(event))
        if self.bridge.next_deadline <= self.now:
            self.bridge.tick(self.now)

    def require_service(self):
        """A client beside them is served."""
        session = self.bridge.open(Caller("fuzz"))
        receive(self.bridge, session, '{"op": "call_service", "service": "/rosapi/get_time"}', self.now)
        (answer,) = [one for one in self.bridge.events() if isinstance(one, Send) and one.session is session]
        assert b'"result":true' in answer.packet.frames[0]
        self.bridge.lost(session)

    def leave(self):
        for session in self.sessions:
            self.bridge.lost(session)
        self.bridge.tick(self.now + 1000)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_nonsense_is_survived_and_forgotten(seed):
    fuzzed = Fuzzed(seed)
    fuzzed.run(4_000)
    assert fuzzed.robot.heard > 20
    assert fuzzed.frames > 4_000
    fuzzed.leave()
    assert list(fuzzed.bridge.topics) == ["/command"]
    assert [name for name in fuzzed.bridge.services if not name.startswith("/rosapi/")] == ["/trigger"]
    assert fuzzed.bridge.next_deadline == math.inf


def test_nonsense_through_sockets():
    dice = random.Random(7)
    with BridgeServer(port=0) as server:
        server.serve("/trigger", TRIGGER, lambda request, caller: {"success": True})
        server.subscribe("/command", COMMAND, Refuses())
        for _ in range(5):
            with connect(server.url, close_timeout=0.1) as client, contextlib.suppress(ConnectionClosed):
                for _ in range(300):
                    client.send(mutated(dice))
        with connect(server.url, compression=None) as client:
            client.send('{"op": "call_service", "service": "/rosapi/get_time"}')
            assert '"result":true' in client.recv(timeout=10)
