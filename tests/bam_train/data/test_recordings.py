"""A deployment and an evaluation with the same seeds are the same episodes; a cut recording costs its end alone."""

from pathlib import Path

import pytest

from bam_train.cli import deploy
from bam_train.cli import eval as evaluation
from bam_train.cli.data import bam_data
from bam_train.data import DataSet
from bam_train.data.recordings import is_data_set
from bam_train.recording.recorder import Recorder

pytest.importorskip("mujoco")
pytest.importorskip("pyarrow")
CHECKPOINT = str(Path(__file__).parents[3] / "checkpoints" / "reach-ppo.zip")


def deploy_program(arguments):
    deploy.main(arguments=arguments)


def eval_program(arguments):
    evaluation.main(arguments=arguments)


def run(main, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(one) for one in arguments])
    return stop.value.code


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A deployment of two episodes in the data set ``deployed``, and its recording."""
    with pytest.MonkeyPatch.context() as patch:
        folder = tmp_path_factory.mktemp("recorded")
        patch.chdir(folder)
        options = ("--episodes", 2, "--seed", 5, "--fast", "--record", "deployed")
        assert run(deploy_program, CHECKPOINT, *options) == 0
    return folder


def test_deployed_and_evaluated_episodes_are_the_same(folder):
    assert run(eval_program, CHECKPOINT, "--episodes", 2, "--seed", 5, "--record", folder / "evaluated") == 0
    one, other = DataSet.open(folder / "deployed"), DataSet.open(folder / "evaluated")
    assert sorted(one.digests) == sorted(other.digests)
    assert one.info.observation_space == other.info.observation_space
    by_seed = {episode.facts["seed"]: episode for episode in other}
    for episode in one:
        twin = by_seed[episode.facts["seed"]]
        assert episode.columns["command"].tobytes() == twin.columns["command"].tobytes()
        assert episode.facts["policy"] == twin.facts["policy"]


def test_recordings_are_imported_once_and_up_to_their_cut(folder, capsys):
    [recording] = (folder / "recordings").glob("*.mcap")
    assert run(bam_data.main, "import", folder / "deployed", recording) == 0
    said = (
        f": episode 0 and 1 more: is in {folder / 'deployed'} already; bam-data import --again adds it all the same\n"
    )
    assert capsys.readouterr().err.endswith(said)
    assert run(bam_data.main, "import", folder / "deployed", recording, "--set", "rate=30") == 1
    said = f"--set: {recording} says the arguments of its environment; leave --set out\n"
    assert capsys.readouterr().err == f"bam-data import: {said}"
    assert len(DataSet.open(folder / "deployed")) == 2
    cut, data = folder / "cut.mcap", recording.read_bytes()
    whole = list(DataSet.open(folder / "deployed"))
    for size in range(0, len(data), len(data) // 8):
        cut.write_bytes(data[:size])
        place = folder / f"cut-{size}"
        status = run(bam_data.main, "import", place, cut, "--group", "cell-7", "--task", "reach it")
        shown = capsys.readouterr()
        assert (status, len(shown.err.splitlines()) <= 1) in ((0, True), (1, True))
        assert place.exists() == (status == 0)
        for index, one in enumerate(DataSet.open(place) if status == 0 else ()):
            assert one.observations.tobytes() == whole[index].observations[: len(one) + 1].tobytes()
            assert one.actions.tobytes() == whole[index].actions[: len(one)].tobytes()
            assert (one.facts["group"], one.facts["task"]) == ("cell-7", "reach it")
            assert (one.digest == whole[index].digest) == ("end" not in one.facts)
            assert ("end" in one.facts) == one.truncated


def test_a_recording_without_an_episode_is_one_line_and_leaves_nothing(folder, capsys):
    recorder = Recorder(folder / "none.mcap", {"env": "bam/reach-v0"})
    recorder.start()
    assert recorder.close() == ""
    before = DataSet.open(folder / "deployed").digest
    for place in ("made", "deployed"):
        assert run(bam_data.main, "import", folder / place, recorder.path) == 1
        assert capsys.readouterr().err == f"bam-data import: {recorder.path}: has no whole episode. Leave it out\n"
    assert not (folder / "made").exists()
    assert DataSet.open(folder / "deployed").digest == before


def test_what_is_a_data_set(tmp_path):
    (tmp_path / "folder.mcap").mkdir()
    (tmp_path / "file").write_text("")
    data_sets = ("s3://bucket/x.mcap", "data/pick", "pick/", f"{tmp_path}/folder.mcap", "file:///tmp/new")
    assert [is_data_set(text) for text in data_sets] == [True] * 5
    assert [is_data_set(text) for text in ("x.mcap", "a/b.c", f"{tmp_path}/file")] == [False] * 3
