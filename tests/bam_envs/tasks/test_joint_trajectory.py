"""Recorded joint trajectories."""

import json
import os

import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.robots.physics.kinematic_arm import ArmContacts
from bam_envs.robots.ur import UR_MODELS, ur_model
from bam_envs.tasks.ur_track import load_trajectory
from tests.bam_envs.tasks.make_ur_track import trajectory

LIMITS = ur_model("ur5").joint_limits


def shipped():
    return [one[:length] for one, length in zip(*load_trajectory(None, LIMITS), strict=True)]


def test_the_shipped_one():
    segments = shipped()
    assert [len(one) for one in segments] == [162, 137, 213]
    for one, following in zip(segments, segments[1:] + segments[:1], strict=True):
        np.testing.assert_array_equal(one[-1], following[0])
        speed = np.diff(one, axis=0) * 20
        assert np.abs(speed).max() < 0.2 * np.pi  # what the arm's controller does at most
        assert np.abs(np.diff(speed, axis=0) * 20).max() < 0.6
        np.testing.assert_allclose(speed[[0, -1]], 0, atol=0.01)


@pytest.mark.parametrize("name", UR_MODELS)
def test_no_arm_touches_anything_on_it(name):
    assert not ArmContacts(UR_MODELS[name]).touching(np.concatenate(shipped())).any()


def test_it_is_made_again():
    for one, made in zip(shipped(), trajectory(), strict=True):
        np.testing.assert_allclose(one, made, atol=1.01e-4)  # the last digit may be another on another machine


def test_short_segments_are_filled_up(tmp_path):
    path = tmp_path / "two.json"
    first, second = np.arange(18.0).reshape(3, 6) / 10, np.full((2, 6), -1.0)
    path.write_text(json.dumps({"trajectory": [first.tolist(), second.tolist()], "comment": "x"}))
    waypoints, lengths = load_trajectory(path, LIMITS)
    assert lengths.tolist() == [3, 2]
    np.testing.assert_array_equal(waypoints, [first, [second[0]] * 3])


@pytest.mark.parametrize(
    ("content", "text"),
    [
        ("[", "The trajectory {path} is not JSON: Expecting value: line 1 column 2 (char 1)."),
        ("[]", "The trajectory {path}: expected a table of named values, found []"),
        ("{}", "The trajectory {path}: trajectory: expected a list of segments, found None"),
        ('{"trajectory": []}', "The trajectory {path}: trajectory: expected a list of segments, found []"),
        ('{"trajectory": [[]]}', "The trajectory {path}: trajectory[0]: expected a list of waypoints, found []"),
        (
            '{"trajectory": [[[0, 0, 0, 0, 0, 0]], [[1, 2], [3]]]}',
            "The trajectory {path}: trajectory[1][0]: expected six joint positions, found [1, 2]",
        ),
        (
            '{"trajectory": [[[0, 0, 0, 0, 0, NaN]]]}',
            "The trajectory {path}: trajectory[0][0][5]: expected a finite number, found nan",
        ),
        (
            '{"trajectory": [[[0, 0, 3, 0, 0, 0], [0, 0, 3.2, 0, 0, 0]]]}',
            "Segment 0 of the trajectory has joint 2 at 3.2 rad in waypoint 1; expected -3.14159 to 3.14159.",
        ),
    ],
)
def test_files_that_are_none(tmp_path, content, text):
    path = tmp_path / "bad.json"
    path.write_text(content)
    with pytest.raises(InvalidValue) as caught:
        load_trajectory(path, LIMITS)
    assert str(caught.value) == text.format(path=path)


def test_files_without_an_end(tmp_path):
    large, pipe = tmp_path / "large.json", tmp_path / "pipe.json"
    with large.open("wb") as file:
        file.truncate(2**24 + 1)
    os.mkfifo(pipe)
    for path, found in ((large, "has 16777217 bytes, expected at most 16777216"), (pipe, "is no plain file")):
        with pytest.raises(InvalidValue, match=f"^The trajectory {path} {found}"):
            load_trajectory(path, LIMITS)


@pytest.mark.parametrize("file", [5, True, b"track.json", ["track.json"]])
def test_no_path(file):
    with pytest.raises(InvalidValue) as caught:
        load_trajectory(file, LIMITS)
    assert str(caught.value) == f"The trajectory must be the path of a JSON file, not {file!r}."


def test_no_file(tmp_path):
    path = tmp_path / "none.json"
    with pytest.raises(InvalidValue) as caught:
        load_trajectory(path, LIMITS)
    assert str(caught.value) == f"The trajectory {path} cannot be read: No such file or directory."
