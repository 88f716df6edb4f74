"""Digits, MNIST's files, circles."""

import shutil

import gymnasium as gym
import numpy as np
import pytest

from bam_envs.core.errors import InvalidValue
from bam_envs.local.picture_tasks import Digits, Mnist
from tests.object_store import bucket_fixture  # noqa: F401


def test_the_splits_of_the_digits_never_mix():
    (train, _), (test, labels) = Digits(1).pictures(), Digits(1, split="test").pictures()
    assert (len(train), len(test)) == (1438, 359)
    assert len({one.tobytes() for one in (*train, *test)}) == 1797
    assert np.bincount(labels).min() >= 35


@pytest.mark.parametrize(("env_id", "side"), [("bam/digits-v0", 8), ("bam/mnist-v0", 28)])
@pytest.mark.parametrize("split", ["train", "test"])
def test_the_digit_is_the_reward(mnist, env_id, side, split):
    options = {"data": str(mnist)} if side == 28 else {}
    envs = gym.make_vec(env_id, num_envs=500, split=split, **options)
    images, labels = envs.unwrapped.task.pictures()
    observation, _ = envs.reset(seed=0)
    assert observation.shape == (500, side, side)
    assert (observation.min(), observation.max()) == (0, 1)
    drawn = envs.unwrapped.task.drawn
    assert len(np.unique(drawn)) > 0.65 * min(500, len(labels))
    np.testing.assert_allclose(observation * images.max(), images[drawn], atol=1e-4)
    actions = np.arange(500) % 10
    _, reward, *_, infos = envs.step(actions)
    np.testing.assert_array_equal(reward, labels[drawn] == actions)
    np.testing.assert_array_equal(infos["final_info"]["label"], labels[drawn])
    np.testing.assert_array_equal(infos["final_info"]["is_success"], reward == 1)


def cut(path):
    path.write_bytes(path.read_bytes()[:-7])


FILES = [
    ("train-images-idx3-ubyte", lambda path: path.unlink(), ": there is no {0} or {0}.gz."),
    ("train-images-idx3-ubyte", cut, "/{0}: expected 31376 bytes, found 31369."),
    ("train-images-idx3-ubyte", lambda path: path.write_bytes(b""), "/{0}: expected an IDX file that begins with "
     "00000803, found nothing."),
    ("train-images-idx3-ubyte", lambda path: path.write_bytes(b"<html>" + bytes(99)), "/{0}: expected an IDX file "
     "that begins with 00000803, found 3c68746d."),
    ("train-labels-idx1-ubyte.gz", cut, "/train-labels-idx1-ubyte is cut short: Compressed file ended before the "
     "end-of-stream marker was reached."),
    ("train-labels-idx1-ubyte.gz", lambda path: shutil.copy(path.with_name(path.name.replace("train", "t10k")), path),
     ": expected pictures of 28 x 28 pixels, each with a label from 0 to 9; found (40, 28, 28) and 20 labels."),
]  # fmt: skip


@pytest.mark.parametrize(("name", "spoil", "message"), FILES)
def test_files_that_cannot_be_used(mnist, name, spoil, message):
    spoil(mnist / name)
    with pytest.raises(InvalidValue) as caught:
        Mnist(1, data=mnist).pictures()
    remedy = " Put MNIST's four files there, as they are or gzipped, or give their folder with data=."
    assert str(caught.value) == f"{mnist}{message.format(name)}{remedy}"


def test_mnist_from_an_address(mnist):
    images, labels = Mnist(1, data=f"file://{mnist}", split="test").pictures()
    np.testing.assert_array_equal(images, Mnist(1, data=str(mnist), split="test").pictures()[0])
    np.testing.assert_array_equal(labels, np.arange(20) % 10)
    with pytest.raises(InvalidValue, match=r"^ftp://a/b: cannot read train-images-idx3-ubyte: .* Put MNIST's four"):
        Mnist(1, data="ftp://a/b").pictures()
    with pytest.raises(InvalidValue, match=r": there is no train-images-idx3-ubyte or train-images-idx3-ubyte\.gz\."):
        Mnist(1, data=f"file://{mnist.parent}").pictures()


def test_mnist_from_a_bucket(mnist, bucket):
    from pyarrow import fs

    system, root = fs.FileSystem.from_uri(f"{bucket}/mnist")
    for path in mnist.iterdir():
        with system.open_output_stream(f"{root}/{path.name}", compression=None) as stream:
            stream.write(path.read_bytes())
    for ours, theirs in zip(Mnist(1, data=f"{bucket}/mnist").pictures(), Mnist(1, data=mnist).pictures(), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    with pytest.raises(InvalidValue, match=r"^s3://bam-lab/none: there is no train-images-idx3-ubyte or "):
        Mnist(1, data=f"{bucket}/none").pictures()


def test_a_split_that_does_not_exist():
    with pytest.raises(InvalidValue, match=r"^split: expected .*'validation'$"):
        gym.make("bam/digits-v0", split="validation")


@pytest.mark.parametrize(("size", "least", "greatest"), [(256, 5, 20), (64, 1, 5)])
def test_circles(size, least, greatest):
    envs = gym.make_vec("bam/grasp-xy-v0", num_envs=40, size=size)
    pictures, _ = envs.reset(seed=0)
    assert pictures.shape == (40, size, size, 3)
    circles = envs.unwrapped.task.circles
    assert (circles[..., 2].min(), circles[..., 2].max()) == (least, greatest)
    grid = np.arange(size)
    red = np.zeros((40, size, size), bool)
    for env, row in enumerate(circles):
        for x, y, radius in row:
            red[env] |= (grid - x) ** 2 + (grid[:, None] - y) ** 2 <= radius**2
    np.testing.assert_array_equal(pictures[..., 0], np.where(red, 255, 0))
    assert not pictures[..., 1:].any()


def test_touching_circles():
    envs = gym.make_vec("bam/grasp-xy-v0", num_envs=60)
    pictures, _ = envs.reset(seed=1)
    actions = envs.unwrapped.task.circles[:, 2, :2] + [4, 0]
    actions[30:] = np.random.default_rng(0).integers(256, size=(30, 2))
    red = pictures[np.arange(60), actions[:, 1], actions[:, 0], 0] == 255
    _, reward, *_, infos = envs.step(actions)
    assert red[:30].all()
    assert not red.all()
    np.testing.assert_array_equal(reward, np.where(red, 1, -1))
    np.testing.assert_array_equal(infos["final_info"]["is_success"], red)


@pytest.mark.parametrize("size", [15, 1025])
def test_sizes_that_are_refused(size):
    with pytest.raises(InvalidValue, match=r"^size: expected a whole number from 16 to 1024, found "):
        gym.make("bam/grasp-xy-v0", size=size)
