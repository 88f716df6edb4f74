"""bam-data import of bags of ROS 2, which mcap_ros2 wrote: what the topics said at each period, and what is refused."""

import numpy as np
import pytest
from mcap.writer import Writer as PlainWriter
from mcap_ros2.writer import Writer

from bam_envs.ros.images import encode_image
from bam_train.cli.data.bam_data import main
from bam_train.data import DataSet

HEADER = """std_msgs/Header header
{}
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
STATES = HEADER.format("string[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort")
IMAGE = HEADER.format("string format\nuint8[] data")
ARRAY = """std_msgs/MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
"""
NAMES = ["gripper", "wrist_roll", "wrist_flex", "elbow_flex", "shoulder_lift", "shoulder_pan"]
COMMANDS = "/forward_position_controller/commands"
BEGUN = 1_700_000_000


def pose(at):
    """Joints at a time [s] in the order of `NAMES`: pan turns by 0.1 rad/s; the jaw is at 0.5 rad."""
    return [0.5, 0.0, 0.3, -0.2, 0.1, 0.1 * at]


def states(at):
    header = {"stamp": {"sec": BEGUN + int(at), "nanosec": round(at % 1 * 1e9)}, "frame_id": ""}
    return {"header": header, "name": NAMES, "position": pose(at), "velocity": [0.0] * 6, "effort": []}


def command(at):
    """Where pan will be 0.2 s later."""
    joints = pose(at + 0.2)[:0:-1]
    return {"layout": {"dim": [], "data_offset": 0}, "data": [*joints, 0.5]}


def write(path, *, states_to="/joint_states", seconds=3.0, gap=(9.0, 9.0), commands=True, image=None):
    """States at 100 Hz from 0 s on but for `gap`, commands at 50 Hz from 0.5 s on."""
    with path.open("wb") as file, Writer(file) as bag:
        kinds = {
            "states": bag.register_msgdef("sensor_msgs/msg/JointState", STATES),
            "command": bag.register_msgdef("std_msgs/msg/Float64MultiArray", ARRAY),
            "image": bag.register_msgdef("sensor_msgs/msg/CompressedImage", IMAGE),
        }
        for k in range(round(100 * seconds)):
            at = k / 100
            when = round((BEGUN + at) * 1e9)
            if not gap[0] <= at < gap[1]:
                bag.write_message(states_to, kinds["states"], states(at), when, when)
            if commands and at >= 0.5 and k % 2 == 0:
                bag.write_message(COMMANDS, kinds["command"], command(at), when, when)
            if image is not None and k % 10 == 0:
                message = {"header": states(at)["header"], "format": "png", "data": image}
                bag.write_message("/front_camera/color/image_raw/compressed", kinds["image"], message, when, when)
    return path


@pytest.fixture
def arm(run, tmp_path):
    """Imports bags of an SO-101."""

    def imported(*bags, flags=()):
        return run(main, "import", tmp_path / "data", *bags, "--set", "robot_model=so101", *flags)

    return imported


def test_states_and_commands_are_those_of_each_period(arm, tmp_path):
    bag = write(tmp_path / "bag.mcap", gap=(1.5, 2.0))
    status, out, err = arm(bag, flags=("--set", "rate=25", "--task", "turn"))
    assert (status, err) == (0, "")
    data = DataSet.open(tmp_path / "data")
    assert out == f"{tmp_path / 'data'}: 2 episodes, {data.total_frames} steps now\n"
    assert (data.info.env, data.info.env_kwargs["rate"], data.info.period) == ("bam/joints-v0", 25, 0.04)
    before, after = data
    assert before.facts["recording"] == "bag.mcap"
    assert [one.facts["number"] for one in (before, after)] == [0, 1]
    assert before.columns["time"][0] == BEGUN + 0.5
    assert after.columns["time"][0] - BEGUN - 2.0 < 0.04
    for episode, last in ((before, 1.49), (after, 3.0)):
        at = episode.columns["time"] - BEGUN
        np.testing.assert_allclose(np.diff(at), 0.04, atol=1e-6)
        seen, acts = episode.observations, episode.actions
        measured = np.minimum(np.floor(at * 100 + 1e-3) / 100, last)  # one that is a little old is used
        expected = np.array([[*pose(t)[:0:-1], 0.5 * 0.0260435 + 0.0045455] for t in measured])
        np.testing.assert_allclose(seen[:-1], expected, atol=1e-6)
        next_pan = 0.1 * (np.floor((at + 0.04) * 50 + 1e-3) / 50 + 0.2)
        np.testing.assert_allclose(acts[:, 0], next_pan, atol=1e-6)
        np.testing.assert_allclose(acts[:, 1:], expected[:, 1:], atol=1e-6)
        assert (episode.terminated, episode.truncated, episode.success) == (False, True, None)


def test_images_are_in_the_size_of_the_environment_and_a_bag_counts_once(arm, tmp_path):
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :32] = 200
    folder = tmp_path / "bag"
    folder.mkdir()
    (folder / "metadata.yaml").write_text("rosbag2_bagfile_information:\n")
    write(folder / "bag_0.mcap", image=encode_image(pixels), seconds=1.0)
    flags = ("--set", "camera=front", "--set", "image_size=32x24")
    assert arm(folder, flags=flags)[0] == 0
    [episode] = DataSet.open(tmp_path / "data")
    front = episode.observations["front"]
    assert front.shape[1:] == (24, 32, 3)
    assert (front[:, :, :15] == 200).all()
    assert (front[:, :, 17:] == 0).all()
    status, out, err = arm(folder, flags=flags)
    assert (status, out) == (0, f"{tmp_path / 'data'}: 1 episode, {len(episode)} steps now\n")
    assert err.endswith(f"is in {tmp_path / 'data'} already; bam-data import --again adds it all the same\n")


def cut(path):
    write(path)
    path.write_bytes(path.read_bytes()[:-2000])


def changed(path):
    write(path)
    content = bytearray(path.read_bytes())
    content[2000] ^= 1
    path.write_bytes(content)


def json_encoded(path):
    with path.open("wb") as file:
        bag = PlainWriter(file)
        bag.start(profile="ros2", library="test")
        schema = bag.register_schema("sensor_msgs/msg/JointState", "jsonschema", b"{}")
        channel = bag.register_channel("/joint_states", "json", schema)
        bag.add_message(channel, 1, b"{}", 1)
        bag.finish()


OFFERED = "as the profile ros2_so_arm100 names it. It has "


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda path: write(path, states_to="/arm/joint_states"),
            f"has no message on /joint_states, {OFFERED}/arm/joint_states (sensor_msgs/JointState), {COMMANDS} "
            "(std_msgs/Float64MultiArray). Give its arm with --set robot_model=NAME, or its profile with --profile",
        ),
        (
            lambda path: write(path, commands=False),
            f"has no command on {COMMANDS}, /joint_trajectory_controller/joint_trajectory, {OFFERED}/joint_states "
            "(sensor_msgs/JointState). Give its arm with --set robot_model=NAME, or its profile with --profile",
        ),
        (
            json_encoded,
            "/joint_states is json by jsonschema, expected cdr by ros2msg. Record it with ros2 bag record --storage "
            "mcap",
        ),
        (cut, "is cut off or damaged. Save what is whole: mcap recover bag.mcap -o whole.mcap"),
        (changed, "is cut off or damaged. Save what is whole: mcap recover bag.mcap -o whole.mcap"),
    ],
)
def test_what_cannot_be_read_is_one_line(arm, tmp_path, make, message):
    path = tmp_path / "bag.mcap"
    make(path)
    status, out, err = arm(path)
    assert (status, out, err) == (1, "", f"bam-data import: {path}: {message}\n")
    assert not list((tmp_path / "data").rglob("*.parquet"))
