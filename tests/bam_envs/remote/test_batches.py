"""Infos of rows, apart and together."""

import numpy as np
from gymnasium import spaces

from bam_envs.remote.remote_vector_env import join_final, join_infos
from bam_envs.remote.serve.env_server import split_infos
from bam_envs.remote.values import stack

ROWS = [
    {"x": 0.5, "n": 1, "ok": True, "in": {"a": 2}, "arr": np.int8([1, 2])},
    {"x": 1.5, "in": {}, "text": "b"},
    {"x": np.float64(2.5), "n": 3, "ok": False, "in": {"a": 4}, "arr": np.int8([3, 4])},
]


def test_joining_makes_columns_with_masks():
    infos = join_infos(ROWS)
    assert infos["x"].tolist() == [0.5, 1.5, 2.5]
    assert infos["_x"].tolist() == [True, True, True]
    assert (infos["n"].dtype, infos["n"].tolist()) == (np.int64, [1, 0, 3])
    assert infos["_n"].tolist() == [True, False, True]
    assert (infos["ok"].dtype, infos["ok"].tolist()) == (np.bool_, [True, False, False])
    assert infos["in"]["a"].tolist() == [2, 0, 4]
    assert infos["in"]["_a"].tolist() == [True, False, True]
    assert (infos["arr"].dtype, infos["arr"].tolist()) == (np.int8, [[1, 2], [0, 0], [3, 4]])
    assert (infos["text"].dtype, infos["text"].tolist()) == (object, [None, "b", None])
    assert infos["_text"].tolist() == [False, True, False]


def test_splitting_gives_the_rows_back():
    back = split_infos(join_infos(ROWS), 3)
    for row, given in zip(back, ROWS, strict=True):
        assert row.keys() == given.keys()
        assert all(np.array_equal(row[key], given[key]) for key in given)


def test_values_of_several_kinds_keep_them():
    column = join_infos([{"x": 1}, {"x": 0.5}, {"x": [1]}])["x"]
    assert column.tolist() == [1, 0.5, [1]]
    assert column.dtype == object


def test_what_has_no_mask_or_no_rows_is_for_every_row():
    assert split_infos({"x": np.arange(2), "name": "rack", "sizes": [1, 2, 3], "_hidden": 1}, 2) == [
        {"x": 0, "name": "rack", "sizes": [1, 2, 3], "_hidden": 1},
        {"x": 1, "name": "rack", "sizes": [1, 2, 3], "_hidden": 1},
    ]


def test_nothing_is_nothing():
    assert join_infos([{}, {}]) == {}
    assert split_infos({}, 2) == [{}, {}]


def test_observations_are_joined_in_arrays_of_their_own():
    rows = [np.float32([1, 2]), np.float32([3, 4])]
    joined = stack(spaces.Box(-9, 9, (2,)), rows)
    rows[0][:] = 0
    assert joined.tolist() == [[1, 2], [3, 4]]
    assert stack(spaces.Text(3), ["a", "b"]) == ("a", "b")


def test_last_observations():
    infos = [{}, {"final_obs": np.float32([9])}]
    box = join_final(spaces.Box(-9, 9, (1,)), [np.float32([1]), np.float32([2])], infos)
    assert box.tolist() == [[1], [9]]
    assert join_final(spaces.Text(3), ["a", "b"], [{}, {"final_obs": "z"}]).tolist() == [None, "z"]
