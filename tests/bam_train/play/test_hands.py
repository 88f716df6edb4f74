"""Keys as actions: what a key does in every kind of environment, and that a key means the same in all of them."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces

from bam_envs.core.registry import ENVIRONMENTS
from bam_envs.robots.ur5e import GEOMETRY
from bam_envs.tasks.tool_control import TOOL_STEP
from bam_train.environments import make_env
from bam_train.errors import SettingsError
from bam_train.play.hands import hand_for
from bam_train.play.key_map import bounded, move_lines, moved, next_speed, stick_moved, table

STILL = (0.0, 0.0, 0.0, 0.0)
JOINTS = [name for name in ENVIRONMENTS if name in ("bam/reach-v0", "bam/isaac-reach-v0") or name.startswith("bam/ur-")]


class Numbers(gym.Env):
    """An environment of no robot with any action space."""

    def __init__(self, space):
        self.action_space, self.observation_space = space, spaces.Box(0, 1)

    def close(self):
        pass


@pytest.mark.parametrize(
    ("keys", "twist", "grip"),
    [
        ({"KeyW"}, (0.1, 0, 0, 0), 0),
        ({"ArrowUp", "KeyW"}, (0.1, 0, 0, 0), 0),
        ({"KeyW", "KeyS"}, STILL, 0),
        ({"KeyD", "KeyQ"}, (0, -0.1, 0, 0.4), 0),
        ({"PageDown", "KeyC"}, (0, 0, -0.1, 0), 1),
        ({"KeyO", "Enter"}, STILL, -1),
        ({"KeyW", "KeyA"}, (0.1 * (0.1 / math.sqrt(0.1 * 0.1 + 0.1 * 0.1)),) * 2 + (0, 0), 0),
    ],
)
def test_keys_add_up_and_no_sum_is_faster(keys, twist, grip):
    assert moved(keys, 0.1) == (twist, grip)


def test_a_base_goes_forward_and_turns():
    assert moved({"KeyS", "KeyA", "KeyR", "KeyE"}, 0.25, is_base=True) == ((-0.25, 0.0, 0.0, -0.4), 0)
    aside = {"is_base": True, "sideways": True}
    assert moved({"KeyD", "KeyR", "KeyE"}, 0.25, **aside) == ((0.0, -0.25, 0.0, -0.4), 0)
    assert stick_moved([-1.0, 0.0, 0.0, -1.0], [False] * 8, 0.1, **aside) == ((0.0, 0.1, 0.0, 0.0), 0)
    names = [{line[8:] for line in move_lines(is_base=True, sideways=one)} for one in (False, True)]
    assert names[1] - names[0] == {"left", "right"}
    assert [next_speed(speed) for speed in table()["speeds"]] == [0.1, 0.25, 0.05]
    assert bounded((3.0, 4.0, 0.0, 1.0), 0.25, is_base=False) == (0.25 / 5 * 3, 0.25 / 5 * 4, 0.0, 1.0)


def test_a_gamepad_moves_by_its_sticks_and_small_deflections_count_as_none():
    buttons = [False] * 8
    assert stick_moved([0.1, -1.0, 0.0, 0.5], buttons, 0.1, is_base=False)[0] == bounded(
        (0.1, 0.0, -0.05, 0.0), 0.1, is_base=False
    )
    buttons[table()["gamepad"]["open"]] = True
    assert stick_moved([0.0] * 4, buttons, 0.1, is_base=True) == (STILL, -1)


def test_tool_steps_are_the_speed_of_the_key_and_the_gripper_keeps_what_it_was_told():
    hand = hand_for(make_env("bam/pick-v0"))
    expected = np.array([0.1 * 0.05 / TOOL_STEP, 0, 0, 0, -1], np.float32)
    np.testing.assert_array_equal(hand.action(*moved({"KeyW"}, 0.1)), expected)
    closed = [hand.action(*moved({key}, 0.25))[4] for key in ("KeyC", "KeyW", "KeyO", "KeyW")]
    assert closed == [1, 1, -1, -1]
    assert hand.action(*moved({"KeyW"}, 0.25))[0] == 1.0
    assert hand.action(*moved({"KeyQ"}, 0.25))[3] == np.float32(0.4 * 0.05 / 0.05)
    hand.took(np.array([0, 0, 0, 0, 0.5], np.float32))  # a policy closes it, and it stays closed
    assert hand.action(STILL, 0).tolist() == [0, 0, 0, 0, 1]


def test_a_base_gets_speeds():
    hand = hand_for(make_env("bam/navigation-v0"))
    action = hand.action(*moved({"KeyW", "KeyQ"}, 0.25, is_base=hand.is_base))
    np.testing.assert_array_equal(action, np.array([0.5, 0.4 / 0.7], np.float32))


@pytest.mark.parametrize("name", JOINTS)
def test_joints_are_found_that_move_the_tool_along_the_key_or_hold_it(name):
    env = make_env(name)
    env.reset(seed=3)
    hand, inner = hand_for(env), env.unwrapped
    geometry = getattr(getattr(inner.task, "model", None), "geometry", GEOMETRY)
    sent = [geometry.tool_position(inner.state.command[:, :6])[0]]
    for keys in [{"KeyR"}] * 8 + [set()] * 4:
        env.step(hand.action(*moved(keys, 0.05)))
        sent.append(geometry.tool_position(inner.last_state.command[:, :6])[0])
    way = sent[8] - sent[0]
    assert way[2] > 0.6 * 8 * 0.05 * inner.period
    assert np.abs(way[:2]).max() < 0.1 * way[2] + 1e-4
    np.testing.assert_allclose(sent[9:], [sent[8]] * 4, atol=5e-4)
    env.close()


def test_the_tool_of_a_described_arm_follows_the_keys():
    env = make_env("bam/joints-v0", {"robot_model": "so101"})
    env.reset(seed=0)
    hand, task = hand_for(env), env.unwrapped.task
    sent = []
    for keys in [{"KeyR", "KeyC"}] * 20:
        env.step(hand.action(*moved(keys, 0.05)))
        sent.append(env.unwrapped.state.command[0].copy())
    way = np.diff(task.arm.tool_position(np.array([sent[0][:-1], sent[-1][:-1]])), axis=0)[0]
    assert way[2] > 0.6 * 19 * 0.05 * 0.05
    assert np.abs(way[:2]).max() < 0.25 * way[2]
    assert sent[-1][-1] < 0.5 * sent[0][-1]
    env.close()


@pytest.mark.parametrize("name", JOINTS)
def test_the_action_for_a_command_leads_to_it(name):
    env = make_env(name)
    env.reset(seed=1)
    task, state = env.unwrapped.task, env.unwrapped.state
    wanted = state.command.copy()
    wanted[:, task.free if hasattr(task, "free") else slice(6)] += 1e-3
    command = task.command(task.action_for(wanted, state), state)
    np.testing.assert_allclose(command[:, :6], wanted[:, :6], atol=1e-6)
    env.close()


def test_choices_are_digits_and_the_arrows_that_the_environment_names():
    hand = hand_for(make_env("bam/grid-world-v0"))
    assert [hand.press(key) and int(hand.action(STILL, 0)) for key in ("ArrowRight", "ArrowUp", "Digit2", "KeyW")] == [
        0,
        1,
        2,
        False,
    ]
    assert hand.waits
    lines = ["0 left, 2 right", "0       action 0", "1       action 1", "2       action 2"]
    assert hand_for(Numbers(spaces.Discrete(3))).lines() == [*lines, "←       action 0", "→       action 2"]
    shifted = hand_for(Numbers(spaces.Discrete(2, start=5)))
    assert [shifted.press(key) for key in ("Digit0", "Digit5", "Digit6", "Digit7")] == [False, True, True, False]
    assert type(shifted.action(STILL, 0)) is np.int64


def test_other_numbers_are_chosen_and_changed():
    hand = hand_for(Numbers(spaces.Box(-2.0, 2.0, (2, 2))))
    for key in ("Digit3", "Equal", "Equal", "ArrowDown", "Minus", "Digit7"):
        assert not hand.press(key)
    assert hand.action(STILL, 0).tolist() == [[np.float32(-0.2), 0], [0, np.float32(0.4)]]
    assert hand.action(STILL, 0).dtype == np.float32
    assert hand.lines()[0] == "0 to 3  choose a number (↑ ↓ too), now number 0"
    pixels = hand_for(Numbers(spaces.MultiDiscrete([4, 256])))
    pressed = [pixels.press(key) for key in ("Digit1", "PageUp", "Equal", "Digit0", "Minus", "Enter")]
    assert pressed == [False] * 5 + [True]
    assert pixels.action(STILL, 0).tolist() == [0, 11]


def test_what_nobody_can_press_is_refused():
    space = spaces.Dict(a=spaces.Discrete(2))
    with pytest.raises(SettingsError, match="actions of Box, Discrete and MultiDiscrete spaces, not of Dict"):
        hand_for(Numbers(space))
    with pytest.raises(SettingsError, match="no motions of a tool or a base, so a person cannot drive this live robot"):
        hand_for(Numbers(spaces.Box(-1, 1)), is_live=True)
