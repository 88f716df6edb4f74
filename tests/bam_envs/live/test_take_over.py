"""What a program hears of the live agent from which it took a robot over."""

import pytest

from bam_envs.live.take_over import TakeOver
from bam_envs.ros.codec import AGENT_TOPIC
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.string_rpc import StringRpcService
from tests.bam_envs.rosbridge.test_string_rpc import LocalBus


def row(number, altered, held=0, stopped=0):
    return {"number": number, "altered": altered, "held": held, "stopped": stopped}


@pytest.mark.parametrize(
    ("before", "after", "guards"),
    [
        (
            {"joint speed": row("G8", 40), "following": row("G23", 0), "jerk": row("G9", 3)},
            {"joint speed": row("G8", 43), "following": row("G23", 0, 2, 1), "jerk": row("G9", 3)},
            {"joint speed": row("G8", 3), "following": row("G23", 0, 2, 1)},
        ),
        ({"jerk": row("G9", 9, 4)}, {"jerk": row("G9", 2, 6)}, {"jerk": row("G9", 2, 6)}),  # connected anew meanwhile
        (None, None, {}),  # of an agent that does not tell them
    ],
)
def test_the_agents_guards_count_since_it_was_taken_over(before, after, guards):
    told = iter([before, before, after])

    def answer(payload, caller):
        counts = next(told)
        return {"state": "paused"} | ({} if counts is None else {"guards": counts})

    bus = LocalBus()
    bus.namespace = ""
    service = StringRpcService(bus, AGENT_TOPIC, answer).start()
    took = TakeOver(bus, Tagger())
    took.take()
    took.take()  # the next episode: the counts go on
    assert (took.hand_back(), took.guards) == ("paused", guards)
    service.close()
