"""Data sets in a bucket: the same files, digests and refusals as on a disk."""

import os
import subprocess
import sys
from urllib.parse import urlsplit

import numpy as np
import pytest

from bam_train.cli.data.bam_data import main
from bam_train.data import DataSet, DataSetWriter
from bam_train.data.layout import LOCK, Files
from bam_train.data.mending import look, mend
from bam_train.errors import BadDataSet, PlaceError
from bam_train.files.place import Place
from tests.bam_train.data import episode_samples as samples
from tests.bam_train.data.episode_samples import episode, info_of
from tests.object_store import Proxy, bucket_fixture  # noqa: F401

INFO = info_of()


def write(place, numbers, **options):
    samples.write(place, INFO, [episode(INFO, 20, number) for number in numbers], **options)


def test_a_bucket_has_what_a_disk_has(bucket, tmp_path):
    for place in (tmp_path / "data", f"{bucket}/data"):
        write(place, range(3))
        write(place, range(3, 5))
    here, there = DataSet.open(tmp_path / "data"), DataSet.open(f"{bucket}/data")
    assert (len(there), there.digests) == (5, here.digests)
    for one, other in zip(here.episodes(), there.episodes(), strict=True):
        assert np.array_equal(one.observations, other.observations)
    assert not (Place(bucket) / "data" / LOCK).exists()


@pytest.mark.parametrize("command", ["info", "stats", "check"])
def test_reading_what_is_not_there_names_the_bucket(bucket, capsys, command):
    why = "there is no bucket none-such. Check the name and the endpoint, or make the bucket"
    nothing = "no such file or folder. Check the name"
    for place, text in (("s3://none-such/d", why), (f"{bucket}/none", nothing)):
        with pytest.raises(SystemExit) as stop:
            main([command, place])
        assert (stop.value.code, capsys.readouterr().err) == (1, f"bam-data {command}: {place}: {text}\n")


def test_damage_in_a_bucket_is_mended(bucket):
    place = Place(f"{bucket}/damaged-set")
    for number in range(3):
        write(place, [number])
    whole = {one: (place / one).read_bytes() for one in ("meta/info.json", "meta/bam.json")}
    name = "meta/episodes/chunk-000/file-001.parquet"
    (place / name).write(b"PAR1")
    (place / "meta/bam.json").delete()
    assert mend(Files(place)).problems == ["meta/bam.json is missing", f"{name} is not as it was written"]
    assert [one.facts["seed"] for one in DataSet.open(place)] == [0, 1, 2]
    assert {one: (place / one).read_bytes() for one in whole} == whole
    assert look(Files(place)).is_whole


def test_one_writer_in_a_bucket(bucket):
    place = f"{bucket}/locked"
    with DataSetWriter(place, INFO), pytest.raises(BadDataSet, match=f"is being written by process {os.getpid()} on "):
        DataSetWriter(place, INFO)
    write(place, range(1))


def test_a_writer_that_was_killed_loses_what_it_had_not_flushed_and_nothing_else(bucket):
    place = f"{bucket}/killed"
    code = f"""
import os
from tests.bam_train.data.test_places_of_data import *
writer = DataSetWriter({place!r}, INFO, flush_episodes=2)
for number in range(5):
    writer.add(episode(INFO, 20, number))
os._exit(9)
"""
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 9
    assert len(DataSet.open(place)) == 4
    write(place, range(4, 6))
    there = DataSet.open(place)
    assert [there.facts(index)["seed"] for index in range(len(there))] == list(range(6))


def test_a_connection_that_is_cut_while_episodes_are_read(bucket):
    write(f"{bucket}/cut", range(40))
    service = urlsplit(os.environ["AWS_ENDPOINT_URL"])
    with Proxy((service.hostname, service.port), after=20_000, cuts=2) as proxy:
        data = DataSet.open(f"{bucket}/cut?endpoint_override={proxy.endpoint}")
        assert [one.facts["seed"] for one in data.episodes()] == list(range(40))
    with Proxy((service.hostname, service.port), after=10**9, cuts=0) as proxy:
        data = DataSet.open(f"{bucket}/cut?endpoint_override={proxy.endpoint}")
        proxy.after, proxy.cuts = 0, 10**6
        with pytest.raises(PlaceError, match="cannot be read: no connection"):
            list(data.episodes())


def test_an_export_goes_to_a_bucket_whole_and_alone(bucket, tmp_path):
    write(f"{bucket}/exported/from", range(3))
    for place in (f"{bucket}/exported/to", str(tmp_path / "to")):
        with pytest.raises(SystemExit) as ended:
            main(["export", f"{bucket}/exported/from", "--to", "lerobot", "--out", place])
        assert ended.value.code == 0
    assert sorted(one.name for one in (Place(bucket) / "exported").list()) == ["from", "to"]
    assert DataSet.open(f"{bucket}/exported/to").digests == DataSet.open(tmp_path / "to").digests
