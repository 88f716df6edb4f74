"""Images as messages: exact pixels, errors."""

import base64
import io
import struct
import sys
import zlib

import numpy as np
import PIL.Image
import pytest

from bam_envs.core.errors import InvalidValue, MissingExtra, ProtocolError
from bam_envs.ros import images

RNG = np.random.default_rng(0)
SHAPES = [(8, 9), (8, 9, 1), (8, 9, 3), (8, 9, 4), (1, 1, 3)]


def pixels(shape):
    return RNG.integers(0, 256, shape, dtype=np.uint8)


def depth_png(millimetres):
    file = io.BytesIO()
    PIL.Image.fromarray(millimetres.astype(np.uint16)).save(file, "png")
    return file.getvalue()


@pytest.mark.parametrize("shape", SHAPES)
def test_png_keeps_every_bit(shape):
    image = pixels(shape)
    decoded = images.decode_image(images.encode_image(image))
    np.testing.assert_array_equal(decoded.reshape(shape), image)
    assert decoded.dtype == np.uint8


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_channels_are_red_green_blue_in_the_file(kind):
    image = np.full((16, 16, 3), (10, 20, 30), np.uint8)
    data = images.encode_image(image, kind)
    with PIL.Image.open(io.BytesIO(data)) as file:
        assert file.format == kind.upper()
        np.testing.assert_allclose(np.asarray(file), image, atol=2)
    np.testing.assert_allclose(images.decode_image(data), image, atol=2)


@pytest.mark.parametrize(
    ("image", "kind", "text"),
    [
        (np.zeros((8, 8, 3), np.float32), "png", "A png image must be uint8 of shape (height, width, 3), not float32"),
        (np.zeros((8, 8, 2), np.uint8), "png", "must be uint8 of shape (height, width, 3), not uint8 of (8, 8, 2)."),
        (np.zeros((8, 8, 4), np.uint8), "jpeg", "A jpeg image must be uint8"),
        (np.zeros((0, 8, 3), np.uint8), "png", "not uint8 of (0, 8, 3)."),
        (np.zeros((8, 8, 3), np.uint8), "gif", "The image format must be png or jpeg, not 'gif'."),
    ],
)
def test_what_is_no_image_is_refused(image, kind, text):
    with pytest.raises(InvalidValue) as error:
        images.encode_image(image, kind)
    assert text in str(error.value)


def test_a_png_of_16_bits_is_depth_in_millimetres():
    message = {"data": depth_png(np.array([[0, 1], [1234, 65535]]))}
    decoded = images.read_depth_message(message)
    np.testing.assert_array_equal(decoded, np.array([[0.0, 0.001], [1.234, 65.535]], np.float32))
    assert decoded.dtype == np.float32


def test_raw_depth_of_a_rack():
    values = np.array([[500, 1000]], dtype="<u2")
    message = {"height": 1, "width": 2, "encoding": "16UC1", "data": values.tobytes()}
    np.testing.assert_array_equal(images.read_depth_message(message), np.array([[0.5, 1.0]], np.float32))
    big = {**message, "is_bigendian": 1, "data": values.astype(">u2").tobytes()}
    np.testing.assert_array_equal(images.read_depth_message(big), np.array([[0.5, 1.0]], np.float32))
    metres = {**message, "encoding": "32FC1", "data": np.array([[0.5, 2.0]], "<f4").tobytes()}
    np.testing.assert_array_equal(images.read_depth_message(metres), np.array([[0.5, 2.0]], np.float32))
    nothing = {**metres, "data": np.array([[np.nan, np.inf]], "<f4").tobytes()}
    np.testing.assert_array_equal(images.read_depth_message(nothing), np.zeros((1, 2), np.float32))


@pytest.mark.parametrize(
    ("message", "text"),
    [
        ({"encoding": "rgb8", "data": b"abc"}, "must be a PNG or one of 16UC1, mono16, 32FC1, not 'rgb8'"),
        ({"encoding": "16UC1", "height": 2, "width": 2, "data": b"abc"}, "must have height x width pixels"),
        ({"encoding": "16UC1", "data": "###"}, "data of an image must be bytes or base64"),
        ({"encoding": "16UC1", "data": 3}, "data of an image must be bytes or base64"),
    ],
)
def test_depth_that_cannot_be_read(message, text):
    with pytest.raises(ProtocolError, match=text):
        images.read_depth_message(message)


def test_a_color_message_as_bytes_and_as_base64():
    image = pixels((8, 9, 3))
    message = images.color_message(image, "png", "camera")
    assert message["format"] == "png"
    assert message["header"]["frame_id"] == "camera"
    np.testing.assert_array_equal(images.read_color_message(message), image)
    text = {**message, "data": base64.b64encode(message["data"]).decode()}
    np.testing.assert_array_equal(images.read_color_message(text), image)


def test_an_empty_message_holds_no_image():
    assert images.read_color_message({"format": "", "data": ""}) is None
    assert images.read_depth_message({"data": b""}) is None


def test_a_file_that_would_fill_the_memory():
    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0))
    with pytest.raises(ProtocolError, match="An image cannot be read: "):
        images.decode_image(b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", b"") + chunk(b"IEND", b""))


@pytest.mark.parametrize(
    ("read", "data", "text"),
    [
        (images.decode_image, b"hello", "An image must be a PNG or JPEG file, not one that begins with b'hello'"),
        (images.decode_image, images.encode_image(pixels((8, 9, 3)))[:20], "An image cannot be read: "),
        (images.decode_image, depth_png(np.ones((8, 8))), "A colour image must have 8 bits, not uint16"),
        (
            lambda data: images.read_depth_message({"data": data}),
            images.encode_image(pixels((8, 9, 3))),
            "A depth image must be grey with 16 bits, not uint8",
        ),
    ],
)
def test_damaged_files(read, data, text):
    with pytest.raises(ProtocolError, match=text):
        read(data)


def test_without_a_library(monkeypatch):
    for name in ("PIL", "PIL.Image"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtra, match=r'Sending camera images needs PIL.*pip install "bam-train\[video\]"'):
        images.encode_image(pixels((8, 8, 3)))
