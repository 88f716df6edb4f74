"""What a program is told of the agent from which it took a robot over."""

import pytest

from bam_train.agent.front.robot_front import guards_since


def row(number, altered, held=0, stopped=0, **more):
    return {"number": number, "altered": altered, "held": held, "stopped": stopped, **more}


@pytest.mark.parametrize(
    ("before", "now", "acted"),
    [
        (
            {"joint speed": row("G8", 40), "following": row("G23", 0), "jerk": row("G9", 3)},
            {"joint speed": row("G8", 43, limit=1.0), "following": row("G23", 0, 2, 1), "jerk": row("G9", 3)},
            {"joint speed": row("G8", 3), "following": row("G23", 0, 2, 1)},
        ),
        ({"jerk": row("G9", 9, 4)}, {"jerk": row("G9", 2, 6)}, {"jerk": row("G9", 2, 6)}),  # connected anew meanwhile
        ({}, {"jerk": row("G9", 0)}, {}),
    ],
)
def test_the_agents_guards_count_since_it_was_taken_over(before, now, acted):
    assert guards_since(before, now) == acted
