"""RLlib's own reader of recorded steps reads the numbers of every episode, with its first and last observation."""

import numpy as np
import pytest

from bam_train.data.export import export
from tests.bam_train.data.export.test_export import record

ray = pytest.importorskip("ray")


@pytest.mark.filterwarnings("ignore:.*:DeprecationWarning")  # of Ray Data itself
@pytest.mark.usefixtures("one_ray")
@pytest.mark.parametrize("kind", ["box", "picture"])
def test_rllib(kind, tmp_path):
    import pyarrow.parquet as pq
    from ray.rllib.algorithms.bc import BCConfig
    from ray.rllib.offline.offline_prelearner import OfflinePreLearner

    data = record(tmp_path / "data", kind)
    assert export(data, "rllib", tmp_path / "out").startswith("config.offline_data(input_=[")
    assert len(pq.read_table(tmp_path / "out")) == data.total_frames
    spaces = (data.info.observation_space, data.info.action_space)
    config = BCConfig().environment(observation_space=spaces[0], action_space=spaces[1])
    batch = ray.data.read_parquet(str(tmp_path / "out")).take_batch(10**6)
    reader = OfflinePreLearner.__new__(OfflinePreLearner)
    reader.config = config
    found = reader._map_to_episodes(batch)["episodes"]
    at = 0
    for ours in data:
        for step in range(len(ours)):
            theirs, at = found[at], at + 1
            np.testing.assert_array_equal(theirs.get_observations(0), ours.observations[step])
            np.testing.assert_array_equal(theirs.get_observations(1), ours.observations[step + 1])
            np.testing.assert_array_equal(theirs.get_actions(0), ours.actions[step])
            assert theirs.get_rewards(0) == np.float32(ours.rewards[step])
            last = step == len(ours) - 1
            assert (theirs.is_terminated, theirs.is_truncated) == (last and ours.terminated, last and ours.truncated)
    assert at == len(found)
