"""The console in a real browser: what it shows, what its buttons do, and that nothing moves once nobody holds a key."""

import io
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from bam_envs.arms.description import robot_model
from bam_envs.core.robot import RobotState
from bam_envs.live.camera import CameraImage
from bam_envs.robots.base_description import base_model
from bam_envs.rosbridge.tokens import Tokens
from bam_envs.safety.guard import Limits
from bam_train.agent.agent_states import State
from bam_train.agent.front.jog import JOG_LIFETIME
from bam_train.agent.front.telemetry import Telemetry
from tests.bam_train.agent.browsers import LEAVINGS, Page, browser, new_browser, page, until
from tests.bam_train.agent.fake_agent import FakeAgent
from tests.bam_train.agent.test_telemetry import base_state
from tests.bam_train.cli.test_play import CODES, COMMANDS

__all__ = ["browser", "page"]  # fixtures from elsewhere
DRAWINGS, LEGIBILITY = (Path(__file__).with_name(f"{name}.js").read_text() for name in ("drawings", "legibility"))
ROLES = Tokens({"watching": "watch", "driving": "drive", "secret": "administer"})


@pytest.fixture
def agent():
    with FakeAgent() as agent:
        yield agent


@pytest.fixture
def driven(page, agent):
    """The page that has taken over, and holds no key yet."""
    page.open(agent.url).click("take")
    page.shows("owner", "You drive")
    return page


def test_the_page_shows_everything_and_asks_nobody_else(page, agent):
    page.requested()
    page.open(agent.url).shows("state", "▶ running")
    assert (page.text("name"), page.text("robot")) == ("arm 7", "simulated · a fake arm · ws://10.0.0.9:9090")
    page.shows("tool", "; gripper open by 85 mm")
    page.shows(
        "guards", "✓ joint speed\n0.00 rad/s, limit 1\naltered 3\n✓ tool speed\n0.00 m/s, limit 0.25\nheld 1, stopped 2"
    )
    page.shows("plots", "gripper width [m]\n── gripper_width0.085")
    page.shows("versions", "champion")
    page.shows("audit", "running -> paused: paused by anna (anna at 10.0.0.7:4242)")
    for text in ("4 of 5 (80 %)", "1.3 ms", "0.5 ms of 50.0 ms", "2 of 1000", "champion aaaaaaaaaaaa"):
        page.shows("run", text)
    assert page.text("warnings") == "⚠ link quality (G16): a warning"
    assert "✓ ✓ ✗ · ✓ ✓" in page.text("recent")
    drawn = "const c = document.querySelector('#plots canvas');"
    drawn += "return c.getContext('2d').getImageData(0, 0, c.width, c.height).data.some((value) => value)"
    until(lambda: page.run(drawn), "a chart")
    until(lambda: len(colours(page.element("picture"))) > 500, "the robot")
    assert {url.split("/")[2] for url in page.requested()} == {f"127.0.0.1:{agent.server.port}"}
    assert page.complaints() == []


def colours(canvas):
    return set(Image.open(io.BytesIO(canvas.screenshot_as_png)).convert("RGB").getdata())


def test_a_page_knows_the_state_before_the_agent_reports_again(page, agent):
    agent.reports = False
    page.open(agent.url).shows("state", "▶ running")
    page.shows("why", "because a test says so")


def test_without_the_libraries_that_draw_the_page_says_so_and_everything_else_works(page, agent):
    page.cdp("Network.enable")
    page.cdp("Network.setBlockedURLs", urls=["*uPlot*", "*three*"])
    page.open(agent.url).shows("plots", "The library that draws the charts is missing: install bam-train again")
    page.shows("no-picture", "The robot is not drawn: the library for that did not come. Reload the page; ")
    page.shows("tool", "Tool at x, y, z:")
    assert not page.element("picture").is_displayed()
    page.click("stop")
    page.shows("state", "❚❚ paused")
    page.cdp("Network.setBlockedURLs", urls=[])
    page.complaints()  # of the blocked files


def test_without_webgl_the_page_says_so_and_everything_else_works(agent):
    browser = new_browser("--disable-software-rasterizer")
    try:
        page = Page(browser).open(agent.url)
        page.shows("no-picture", "This browser has no WebGL 2, which draws the robot. Everything else works.")
        page.shows("tool", "Tool at x, y, z:")
        page.shows("plots", "gripper_width")
        page.click("stop")
        page.shows("state", "❚❚ paused")
        assert not page.element("picture").is_displayed()
    finally:
        browser.quit()


def test_a_robot_whose_shape_is_not_known_has_its_numbers(page, agent):
    agent.scene = {}
    page.open(agent.url).shows("no-picture", "This robot's shape is not known; see its numbers.")
    page.shows("tool", "Tool at x, y, z:")
    assert not page.element("picture").is_displayed()


def drawn(page, agent, telemetry, states, goals=()):
    """What the page's picture has of each state: parts (pose and solids by name), differing pixels."""
    page.open(agent.url).shows("tool", "Tool at x, y, z:")
    messages = [{**telemetry.message(state, 0.0), "goals": list(goals)} for state in states]
    found = page.browser.execute_async_script(DRAWINGS, telemetry.scene, messages)
    for one in found:
        for part in one["parts"].values():
            part["pose"] = np.array(part["pose"]).reshape(4, 4).T
    assert page.complaints() == []
    return found


@pytest.mark.parametrize("name", ["fr3", "ur5e"])
def test_the_picture_is_of_the_arm_that_is_meant_in_any_posture(page, agent, name):
    arm = robot_model(name)
    chain, size = arm.chain, arm.num_joints
    telemetry = Telemetry(arm.spec(with_object=True), Limits(), geometry=arm.arm, workspace=np.array(arm.workspace))
    q = chain.low + np.random.default_rng(0).random((3, size)) * (chain.high - chain.low)
    states = []
    for joints, width, x in zip(q, (arm.gripper.open, 0.01, 0.0), (0.5, np.nan, 0.4), strict=True):
        signals = {"joint_position": joints, "joint_velocity": np.zeros(size), "gripper_width": [width]}
        signals |= {"object_position": [x, -0.3, 0.02], "object_quaternion": [1.0, 0.0, 0.0, 0.0]}
        signals = {key: np.array([values], dtype=float) for key, values in signals.items()}
        states.append(RobotState(signals, np.zeros(1), np.zeros((1, size + 1))))
    for state, frames, one in zip(states, chain.link_frames(q), drawn(page, agent, telemetry, states), strict=True):
        parts = one["parts"]
        names = [f"link {link}" for link in range(1, size + 1)] + ["tool"]
        for part, frame in zip(names, frames, strict=True):
            np.testing.assert_allclose(parts[part]["pose"], frame, atol=2e-4)
        capsules = [sum(one.link == link for one in arm.capsules) for link in range(size + 1)]
        assert [parts[f"link {link}"]["solids"] for link in range(size + 1)] == capsules
        ends = [parts[f"pad {side}"]["pose"][:3, 3] for side in (1, -1)]
        width = state.signals["gripper_width"][0, 0]
        np.testing.assert_allclose(ends[0] - ends[1], (width + 0.008) * frames[-1, :3, 0], atol=2e-4)
        assert ("object" in parts) == np.isfinite(state.signals["object_position"][0, 0])
        assert "workspace" in parts


def test_the_picture_changes_with_joints_gripper_and_object(page, agent):
    arm = robot_model("ur5e")
    telemetry = Telemetry(arm.spec(with_object=True), Limits(), geometry=arm.arm)

    def state(turn=0.0, width=0.085, x=np.nan):
        signals = {"joint_position": [turn, *arm.home[1:]], "joint_velocity": [0.0] * 6, "gripper_width": [width]}
        signals |= {"object_position": [x, -0.3, 0.02], "object_quaternion": [1.0, 0.0, 0.0, 0.0]}
        signals = {key: np.array([values], dtype=float) for key, values in signals.items()}
        return RobotState(signals, np.zeros(1), np.zeros((1, 7)))

    states = state(), state(), state(width=0.04), state(x=0.45), state(turn=0.5)
    first, same, narrow, with_object, turned = (one["differing"] for one in drawn(page, agent, telemetry, states))
    assert first == same == 0
    assert 20 < narrow < turned
    assert 100 < with_object < turned


def test_a_base_is_drawn_where_it_is_with_what_it_sees(page, agent):
    telemetry, here, there = Telemetry(base_model("mir100").spec(), Limits()), base_state(), base_state(2.0)
    there.signals["base_pose"] = np.array([[3.0, -1.0, np.pi / 2]])
    first, second = drawn(page, agent, telemetry, [here, there], [[4.0, 1.0, 0.0]])
    np.testing.assert_allclose(second["parts"]["goal 1"]["pose"][:3, 3], [4.0, 1.0, 0.0])
    np.testing.assert_allclose(first["parts"]["base"]["pose"][:3, 3], [1.0, 2.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(second["parts"]["base"]["pose"][:2, [0, 3]], [[0.0, 3.0], [1.0, -1.0]], atol=1e-4)
    assert second["differing"] > 100


def test_the_stop_button_and_the_space_bar_stop_whatever_has_the_focus(page, agent):
    page.open(agent.url).shows("state", "running")
    page.click("stop")
    page.shows("state", "❚❚ paused")
    page.shows("stop-note", "Stopped.")
    for count, focus in enumerate((None, "resume", "stop", "take"), 2):
        page.run("document.activeElement.blur(); document.getElementById(arguments[0])?.focus()", focus)
        page.tap(" ")
        until(lambda count=count: len(agent.did("stop")) == count, "the stop")
    assert [op for op, *_ in agent.orders] == ["stop"] * 5
    page.run("document.getElementById('stop').focus()")
    page.tap("Enter")
    until(lambda: len(agent.did("stop")) == 6, "the stop")
    page.press(" ")
    page.cdp("Input.dispatchKeyEvent", type="rawKeyDown", key=" ", code="Space", autoRepeat=True)
    page.let(" ")
    until(lambda: len(agent.did("stop")) == 7, "the stop")
    assert page.complaints() == []


def test_the_buttons(page, agent):
    page.open(agent.url).click("pause")
    page.shows("state", "❚❚ paused")
    page.click("resume")
    page.shows("state", "▶ running")
    page.click("take")
    page.shows("state", "⇄ taken over")
    page.click("back-pause")
    page.shows("state", "❚❚ paused")
    assert not page.element("jog").is_displayed()
    page.click("take")
    page.click("back-run")
    page.shows("state", "▶ running")
    page.click("roll-back")
    page.click("no")
    page.click("roll-back")
    page.click("yes")
    page.shows("run", "previous bbbbbbbbbbbb")
    orders = [(op, arguments.get("resume"), person.who) for op, _, arguments, person in agent.orders]
    expected = [("pause", None), ("resume", None), ("take", None), ("hand_back", False), ("take", None)]
    expected += [("hand_back", True), ("rollback", None)]
    assert orders == [(*order, "console") for order in expected]


def test_a_first_candidate_can_be_rolled_back_and_a_first_champion_cannot(page, agent):
    agent.names = {"champion": agent.active}
    page.open(agent.url).shows("state", "▶ running")
    assert not page.element("roll-back").is_enabled()
    agent.names, agent.state = {"champion": "b" * 64, "candidate": agent.active}, "trial"
    page.shows("state", "◔ trial")
    assert page.element("roll-back").is_enabled()


def enter(page, agent, token):
    """Open the page and show a token."""
    page.open(agent.url).shows("entry-reason", "This robot asks for a token.")
    page.element("token").send_keys(f"{token}\n")
    until(lambda: page.element("main").is_displayed(), "the page")


def test_a_robot_that_somebody_else_drives_is_taken_by_force_only(page):
    with FakeAgent(ROLES) as agent:
        agent.driver, agent.owner, agent.state = "anna's socket", "anna (10.0.0.7)", "taken over"
        enter(page, agent, "driving")
        page.shows("owner", "anna (10.0.0.7) drives; the lease ends in 20 s unless it is used.")
        page.click("take")
        page.shows("question-text", "anna (10.0.0.7) drives this robot. Take it by force?")
        page.click("no")
        page.click("take")
        page.click("yes")
        page.shows("error", "Taking command by force needs a token of the role administer")
        page.run("sessionStorage.clear()")
        enter(page, agent, "secret")
        page.click("take")
        page.click("yes")
        page.shows("owner", "You drive")
        assert [arguments["force"] for op, _, arguments, _ in agent.orders] == [True]
        agent.driver, agent.owner = "anna's socket", "anna (10.0.0.7)"  # and she takes it back
        page.shows("owner", "anna (10.0.0.7) drives")
        assert not page.element("jog").is_displayed()
        page.run("sessionStorage.clear()")


def test_the_robot_moves_only_while_a_key_is_held(driven, agent):
    for key, axis, way in (("w", 0, 1), ("a", 1, 1), ("f", 2, -1)):
        before = agent.telemetry.message(agent.robot_state(), 0.0)["tool"]
        driven.move(key, lambda: agent.moves)
        driven.let(key)
        until(lambda: not agent.moves, "the end of the motion")
        after = agent.telemetry.message(agent.robot_state(), 0.0)["tool"]
        moved = [new - old for new, old in zip(after, before, strict=True)]
        assert way * moved[axis] > 0.003
        assert max(abs(one) for at, one in enumerate(moved) if at != axis) < 0.002
    assert [message["seq"] for _, message in agent.twists] == list(range(len(agent.twists)))
    assert agent.twists[-1][1]["twist"] == [0, 0, 0, 0]
    driven.shows("jog-state", "Hold a key or button")
    driven.shows("guards", "tool speed")


def test_twenty_keys_give_the_commands_of_bam_play_bit_for_bit(driven, agent):
    commands = []

    def told(sent):  # a page that stood still on a busy computer may say the end of the motion before once more
        found = [(tuple(one["twist"]), one["gripper"]) for _, one in agent.twists[sent:]]
        return next((one for one in found if any(one[0]) or one[1]), None)

    for code in CODES:
        sent = len(agent.twists)
        driven.cdp("Input.dispatchKeyEvent", type="rawKeyDown", key=code, code=code)
        until(lambda sent=sent: told(sent), "the command")
        driven.cdp("Input.dispatchKeyEvent", type="keyUp", key=code, code=code)
        until(lambda: not any(agent.twists[-1][1]["twist"]) and not agent.twists[-1][1]["gripper"], "its end")
        commands.append(told(sent))
    assert commands == COMMANDS


def test_a_button_moves_the_robot_while_it_is_held_and_a_key_with_a_modifier_does_not(driven, agent):
    from selenium.webdriver import ActionChains

    pad = driven.browser.find_element("css selector", "[data-move=Up]")

    def is_held():  # a page that stood still on a busy computer lets go of it: pressed again
        if driven.text("jog-state").startswith("Hold a key"):
            ActionChains(driven.browser).release().move_to_element(pad).click_and_hold().perform()
        return agent.moves and driven.text("jog-state") == "Moving: Up"

    until(is_held, "a motion")
    ActionChains(driven.browser).move_by_offset(0, -300).perform()
    until(lambda: not agent.moves, "the end of the motion")
    ActionChains(driven.browser).release().perform()
    sent = len(agent.twists)
    driven.cdp("Input.dispatchKeyEvent", type="rawKeyDown", key="w", code="KeyW", modifiers=2)
    driven.let("w")
    driven.tap("o")
    until(lambda: len(agent.twists) > sent, "the gripper's command")
    assert agent.twists[sent][1]["gripper"] == -1


def test_drawings_give_way_on_a_busy_computer(driven):
    """A drawing that comes 0.2 s late is followed by a pause of four times as long, in which buttons are heard."""
    driven.run(
        "window.drawn = [];"
        "window.requestAnimationFrame = (draw) =>"
        "  setTimeout(() => (window.drawn.push(performance.now()), draw()), 200);"
    )
    until(lambda: len(driven.run("return window.drawn")) > 3, "drawings")
    assert np.diff(driven.run("return window.drawn")[1:]).min() > 990


@pytest.mark.parametrize("leave", LEAVINGS)
def test_a_page_that_is_left_in_mid_jog_leaves_the_robot_at_rest(driven, agent, leave):
    driven.move("w", lambda: agent.moves)
    leave(driven)
    until(lambda: not agent.moves, "the end of the motion")
    last, joints = agent.twists[-1][0], agent.joints
    assert agent.commands[-1][0] - last <= JOG_LIFETIME
    time.sleep(0.5)
    assert (agent.twists[-1][0], agent.joints is joints) == (last, True)


def test_a_page_that_is_frozen_in_mid_jog_leaves_the_robot_at_rest_also_when_it_thaws(driven, agent):
    driven.move("w", lambda: agent.moves)
    with driven.frozen():
        until(lambda: not agent.moves, "the end of the motion")
        last, joints = agent.twists[-1][0], agent.joints
        assert agent.commands[-1][0] - last <= JOG_LIFETIME
        time.sleep(0.5)
        assert agent.twists[-1][0] == last
    until(lambda: driven.text("jog-state").startswith("Hold a key"), "the release of the key")
    time.sleep(0.3)
    assert [message["twist"] for at, message in agent.twists if at > last] in ([], [[0, 0, 0, 0]])
    assert agent.joints is joints
    driven.let("w")
    driven.press("w")  # pressed again, it moves again
    until(lambda: agent.moves, "a motion")
    driven.let("w")


def test_a_gamepad_moves_the_robot_while_its_shoulder_button_is_held_and_stops_it(page, agent):
    pad = """
      const buttons = Array.from({length: 16}, () => ({pressed: false}));
      window.pad = {mapping: "standard", axes: [0, 0, 0, 0], buttons};
      navigator.getGamepads = () => [null, window.pad];
      document.hasFocus = () => true;
    """
    made = page.cdp("Page.addScriptToEvaluateOnNewDocument", source=pad)
    page.open(agent.url).click("take")
    page.shows("owner", "You drive")
    page.run("pad.axes = [0, -1, 0, 0]")
    time.sleep(0.3)
    assert agent.twists == []
    page.run("pad.buttons[5].pressed = true")
    until(lambda: agent.moves, "a motion")
    assert agent.twists[-1][1]["twist"] == pytest.approx([0.1, 0, 0, 0])
    page.run("pad.axes = [0, 0.1, 0.1, 0]")  # a stick that does not come back to its middle
    until(lambda: not agent.moves, "the end of the motion")
    page.run("pad.buttons[1].pressed = true")
    page.shows("state", "paused")
    assert len(agent.did("stop")) == 1
    page.cdp("Page.removeScriptToEvaluateOnNewDocument", **made)


def test_a_phone_shows_state_and_stop_without_scrolling_sideways(page, agent):
    page.cdp("Emulation.setDeviceMetricsOverride", width=360, height=740, deviceScaleFactor=2, mobile=True)
    page.open(agent.url).click("take")
    page.shows("owner", "You drive")
    page.shows("versions", "champion")
    page.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    in_view = """
      const box = document.getElementById(arguments[0]).getBoundingClientRect();
      const top = document.elementFromPoint(box.x + box.width / 2, box.y + box.height / 2);
      return [box.left >= 0 && box.right <= 360 && box.top >= 0 && box.bottom <= innerHeight, top.id];
    """
    for part in (0, 0.5, 1):
        page.run("scrollTo(0, arguments[0] * document.documentElement.scrollHeight)", part)
        assert page.run("return [document.documentElement.scrollWidth, innerWidth, scrollX]") == [360, 360, 0]
        assert page.run(in_view, "stop") == [True, "stop"]
        assert page.run(in_view, "state") == [True, "state"]
    page.click("stop")
    page.shows("state", "paused")


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_every_text_and_control_is_legible_in_every_state(page, agent, scheme):
    page.cdp("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    page.open(agent.url).shows("versions", "champion")
    page.run("document.querySelectorAll('details').forEach((one) => { one.open = true; })")
    page.shows("plots", "gripper_width")
    for state in (*(one.value for one in State), "not connected"):
        page.run("document.body.dataset.state = arguments[0]", state)
        assert page.run(LEGIBILITY) == []
    page.click("take")
    page.shows("owner", "You drive")
    assert page.run(LEGIBILITY) == []
    page.cdp("Emulation.setEmulatedMedia", features=[])


def test_the_page_is_there_for_a_keyboard_and_a_screen_reader(page, agent):
    page.open(agent.url).shows("state", "running")
    names, focused = set(), "return document.activeElement.id || document.activeElement.tagName"
    for _ in range(20):
        page.tap("Tab")
        names.add(page.run(focused))
    assert {"pause", "take", "roll-back", "stop", "SUMMARY"} <= names
    page.run("document.getElementById('pause').focus()")
    page.tap("Enter")
    page.shows("state", "paused")
    live = page.run("return [...document.querySelectorAll('[aria-live], [role=alert]')].map((one) => one.id)")
    assert set(live) == {"state", "link", "error", "jog-state", "stop-note"}
    nameless = "return [...document.querySelectorAll('button, canvas, progress, section, dialog')].filter((one) =>"
    nameless += " !one.textContent.trim() && !one.ariaLabel).length"
    assert page.run(nameless) == 0


def test_a_token_is_asked_for_kept_in_this_tab_and_never_in_an_address(page):
    with FakeAgent(ROLES) as agent:
        page.requested()
        page.open(agent.url).shows("entry-reason", "This robot asks for a token.")
        assert not page.element("main").is_displayed()
        page.element("token").send_keys("wrong one\n")
        page.shows("entry-reason", "The token is wrong.")
        page.element("person").send_keys("Anna B")
        page.element("token").send_keys("secret\n")
        page.shows("state", "running")
        page.click("pause")
        page.shows("state", "paused")
        assert agent.orders[0][3].who == "Anna B"
        assert page.run("return [sessionStorage.token, localStorage.length, document.cookie]") == ["secret", 0, ""]
        page.browser.refresh()
        page.shows("state", "paused")
        assert not [url for url in page.requested() if "secret" in url or "wrong" in url]
        page.run("sessionStorage.clear()")


@pytest.mark.parametrize(("token", "allowed"), [("watching", set()), ("driving", {"pause", "take"})])
def test_a_role_sees_what_it_may_do_and_everybody_may_stop(page, token, allowed):
    with FakeAgent(ROLES) as agent:
        enter(page, agent, token)
        page.shows("state", "running")
        buttons = ("pause", "resume", "take", "roll-back")
        until(lambda: {one for one in buttons if page.element(one).is_enabled()} == allowed, "the buttons")
        page.click("stop")
        page.shows("state", "paused")
        page.run("sessionStorage.clear()")
        assert len(agent.did("stop")) == 1


def test_an_old_state_is_called_old(page, agent):
    page.open(agent.url).shows("tool", "Tool at x, y, z:")
    agent.measures = False
    page.shows("tool", "⚠ Old: no state of the robot came for")
    agent.measures = True
    page.shows("tool", "Tool at x, y, z:")


def test_what_is_refused_is_said(page, agent):
    page.open(agent.url).shows("state", "running")
    agent.refusal = "anna drives this robot."
    page.click("pause")
    page.shows("error", "⚠ anna drives this robot.")
    agent.refusal = ""
    page.click("pause")
    page.shows("state", "paused")
    assert not page.element("error").is_displayed()


def test_the_page_comes_back_when_the_robot_does(page):
    with FakeAgent() as agent:
        page.open(agent.url).click("take")
        page.shows("owner", "You drive")
        port = agent.server.port
    page.shows("state", "○ not connected")
    page.shows("link", "STOP does not reach it now.")
    assert not page.element("jog").is_displayed()
    page.click("stop")
    page.shows("stop-note", "⚠ STOP did not arrive: There is no connection to the robot. Use the emergency stop.")
    with FakeAgent(port=port) as agent:
        page.shows("state", "▶ running")
        page.tap(" ")
        page.shows("state", "paused")
        assert len(agent.did("stop")) == 1
    page.complaints()  # of the refused connections


class FakeCamera:
    """Takes a picture each time that it is asked."""

    def __init__(self, colour, is_there=True):
        buffer = io.BytesIO()
        Image.new("RGB", (640, 480), colour).save(buffer, "JPEG")
        self.data, self.number = buffer.getvalue(), 0

    def connect(self):
        pass

    def close(self):
        pass

    def file(self):
        self.number += 1
        return self.number, "jpeg", self.data

    def latest(self) -> CameraImage:
        raise NotImplementedError


def test_pictures_of_cameras(page):
    with FakeAgent(cameras={"wrist": FakeCamera("red"), "cell": FakeCamera("blue")}, seen={"wrist": (64, 64)}) as agent:
        page.open(agent.url)
        drawn = "return [...document.querySelectorAll('#cameras canvas')].map((one) => one.drawn)"
        until(lambda: page.run(drawn) and min(page.run(drawn)) > 5, "pictures")
        middle = "const c = document.querySelectorAll('#cameras canvas')[arguments[0]];"
        middle += "return [...c.getContext('2d').getImageData(320, 240, 1, 1).data]"
        assert page.run(middle, 0)[0] > 240
        assert page.run(middle, 1)[2] > 240
        assert page.text("cameras") == "wrist: the policy sees its middle, 64 by 64 pixels\ncell"
        page.click("stop")
        page.shows("state", "paused")
        assert page.complaints() == []
