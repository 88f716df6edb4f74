"""Programs whose files are in a bucket."""

import json
import os
import shutil
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from bam_train.checkpoint import Checkpoint
from bam_train.cli import eval, sign, train
from bam_train.cli.live import replay
from bam_train.errors import PlaceError
from bam_train.files.place import Place, standing_in
from tests.object_store import Proxy, answering, bucket_fixture, environment  # noqa: F401

SHIPPED = Path(__file__).parents[3] / "checkpoints" / "reach-ppo.zip"


@dataclass(frozen=True)
class Written:
    """The configuration of a program."""

    out: Path = Path("out.png")


@pytest.fixture(autouse=True)
def clean(tmp_path, monkeypatch):
    """A temporary folder of its own, which is empty at the end."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    monkeypatch.chdir(tmp_path)
    with standing_in(Written()):
        yield
    assert list(folder.glob("bam-*")) == []


@pytest.fixture
def run(monkeypatch, capsys):
    def run(main, *arguments):
        monkeypatch.setattr(sys, "argv", ["bam", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code or 0, *capsys.readouterr()

    return run


def names(place):
    return sorted(one.name for one in Place(place).list())


def test_a_checkpoint_in_a_bucket_is_evaluated_signed_and_verified(bucket, run, tmp_path):
    Place(f"{bucket}/reach.zip").write(SHIPPED)
    status, out, _ = run(eval.main, f"{bucket}/reach.zip", "--episodes", 2, "--json")
    assert (status, json.loads(out)["checkpoint"]) == (0, f"{bucket}/reach.zip")
    assert run(sign.main, "keygen", tmp_path / "me.key", "--name", "me")[0] == 0
    assert run(sign.main, "trust", tmp_path / "me.pub", "--keys", tmp_path / "trusted")[0] == 0
    status, out, _ = run(sign.main, "sign", f"{bucket}/reach.zip", "--key", tmp_path / "me.key")
    assert (status, out.startswith(f"{bucket}/reach.zip: signed by me, ")) == (0, True)
    status, out, _ = run(sign.main, "verify", f"{bucket}/reach.zip", "--keys", tmp_path / "trusted")
    assert (status, out.startswith(f"{bucket}/reach.zip: signed by me, ")) == (0, True)
    assert names(bucket) == ["reach.zip"]


def test_training_in_a_bucket_and_going_on_from_there(bucket, run, corridor, tmp_path):
    new = ("--env", corridor, "--algo", "ppo", "--set", "n_steps=32", "--set", "num_envs=1", "--eval-episodes", 2)
    into = ("--out", f"{bucket}/out/c.zip", "--runs", f"{bucket}/runs")
    status, out, err = run(train.main, *new, "--steps", 64, *into)
    assert status == 0, err
    assert f"{bucket}/out/c.zip" in out + err
    (first,) = names(f"{bucket}/runs")
    files = {"config.json", "last.zip", "learning-curve.png", "outcome.json", "progress.jsonl", "tensorboard"}
    assert set(names(f"{bucket}/runs/{first}")) == files
    status, out, err = run(train.main, "--resume", f"{bucket}/runs/{first}/last.zip", "--steps", 96, *into)
    assert status == 0, err
    assert f"{bucket}/out/c.zip exists: the checkpoint goes to {bucket}/out/c-2.zip (--force overwrites)" in err
    assert str(tmp_path) not in out + err
    assert (names(f"{bucket}/out"), names(f"{bucket}/runs")) == (["c-2.zip", "c.zip"], [first, f"{first}-2"])
    assert Checkpoint.open(f"{bucket}/out/c-2.zip").manifest.steps == 96
    status, out, err = run(train.main, *new, "--steps", 64, "--start", f"{bucket}/out/c.zip", "--print-config")
    assert (status, json.loads(out)["start"]) == (0, f"{bucket}/out/c.zip"), err
    status, _, err = run(train.main, *new, "--steps", 64, "--start", f"{bucket}/c.zip")
    assert (status, err) == (1, f"bam-train: {bucket}/c.zip: no such file or folder. Check the name\n")


OURS = "takes a path on this computer\n"
VIDEO = "s3://none-such/a.gif"


@pytest.mark.parametrize(
    ("main", "flags", "message"),
    [
        (train.main, "--env bam/reach --algo ppo --out {bucket}/x", "train: {bucket}/x: expected a file name that "),
        (eval.main, "{bucket}/none.zip", "eval: {bucket}/none.zip: no such file or folder. Check the name"),
        (replay.main, "s3://none-such/a.mcap", "replay: s3://none-such/a.mcap: there is no bucket none-such. "),
        (sign.main, f"verify {SHIPPED} --keys {{bucket}}/keys", f"sign: {{bucket}}/keys: --keys {OURS}"),
        (eval.main, f"{SHIPPED} --video {VIDEO}", f"eval: {VIDEO}: --video {OURS}"),
    ],
)
def test_what_is_wrong_is_one_line(main, flags, message, bucket, run):
    status, out, err = run(main, *flags.format(bucket=bucket).split())
    assert (status, out) == (1, "")
    assert err.startswith(f"bam-{message.format(bucket=bucket)}")
    assert err.count("\n") == 1


def test_no_right_to_write_is_known_before_training(run, corridor):
    with answering(403, "AccessDenied") as endpoint, environment(endpoint):
        status, out, err = run(train.main, "--env", corridor, "--steps", 64, "--out", "s3://theirs/c.zip")
    assert (status, out, err.count("\n")) == (1, "", 1)
    assert "not allowed with these credentials. Ask the owner of theirs for the right" in err


def test_what_cannot_be_put_at_the_end_is_kept(bucket):
    service = urlsplit(os.environ["AWS_ENDPOINT_URL"])
    with Proxy((service.hostname, service.port), after=0, cuts=0) as proxy:

        def write(place):
            with standing_in(Written(Path(place))) as config:
                config.out.write_bytes(b"picture")
                proxy.cuts = 10**6

        kept = r"^s3://bam-lab: cannot be written: no connection .*\. What belongs there is kept in /\S+$"
        with pytest.raises(PlaceError, match=kept) as caught:
            write(f"{bucket}/plot.png?endpoint_override={proxy.endpoint}")
    kept = Path(str(caught.value).rpartition(" ")[2])
    assert (kept / "plot.png").read_bytes() == b"picture"
    shutil.rmtree(kept)


def test_what_was_fetched_in_part_is_never_put(bucket, run):
    Place(f"{bucket}/whole.zip").write(SHIPPED)
    service = urlsplit(os.environ["AWS_ENDPOINT_URL"])
    with Proxy((service.hostname, service.port), after=20_000, cuts=10**6) as proxy:
        status, _, err = run(eval.main, f"{bucket}/whole.zip?endpoint_override={proxy.endpoint}")
    assert (status, err.count("\n"), "cannot be read: no connection" in err) == (1, 1, True)
    assert Place(f"{bucket}/whole.zip").read_bytes() == SHIPPED.read_bytes()


def test_file_addresses_are_paths(run):
    status, out, _ = run(eval.main, SHIPPED.as_uri(), "--episodes", 1, "--json")
    assert (status, json.loads(out)["checkpoint"]) == (0, os.fspath(SHIPPED))
