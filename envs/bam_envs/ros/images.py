"""Camera images in ROS messages, as PNG or JPEG; depth as a PNG of uint16 millimetres, or raw.

Arrays are RGB. Message data are `bytes`, or base64 text from a JSON bridge.
"""

import base64
import importlib
import io
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, MissingExtra, ProtocolError

FORMATS = ("png", "jpeg")
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
SIGNATURES = {"png": _PNG, "jpeg": _JPEG}
"""First bytes of an image file of each format."""
_PIXEL_DTYPES = {"16UC1": "u2", "mono16": "u2", "32FC1": "f4"}


def encode_image(image: NDArray[np.uint8], kind: str = "png") -> bytes:
    """`image` as a file: ``"png"``, which keeps every bit, or ``"jpeg"``, which is smaller and has no alpha.

    Its shape is (height, width), (height, width, 1), (height, width, 3) RGB or (height, width, 4) RGBA. `InvalidValue`
    for another shape, dtype or kind. Without Pillow all functions of this module raise `MissingExtra`.
    """
    if kind not in FORMATS:
        raise InvalidValue(f"The image format must be png or jpeg, not {kind!r}.")
    array = np.asarray(image)
    channels = array.shape[2] if array.ndim == 3 else 1
    fits = array.dtype == np.uint8 and array.ndim in (2, 3) and channels in (1, 3, 4) and array.size
    if not fits or (kind == "jpeg" and channels == 4):
        raise InvalidValue(
            f"A {kind} image must be uint8 of shape (height, width, 3), not {array.dtype} of {array.shape}."
        )
    file, options = io.BytesIO(), {"compress_level": 1} if kind == "png" else {"quality": 90}
    array = array[:, :, 0] if array.ndim == 3 and channels == 1 else array
    _pillow().fromarray(np.ascontiguousarray(array)).save(file, kind, **options)
    return file.getvalue()


def decode_image(data: bytes) -> NDArray[np.uint8]:
    """The image in a PNG or JPEG file: uint8, (height, width) if grey, else (height, width, 3 or 4) RGB or RGBA.

    `ProtocolError` if it is not such a file, or its pixels are not 8 bits.
    """
    image = _decode(data)
    if image.dtype != np.uint8:
        raise ProtocolError(f"A colour image must have 8 bits, not {image.dtype}.")
    return image


def color_message(
    image: NDArray[np.uint8], kind: str = "png", frame_id: str = "", stamp: Mapping[str, int] | None = None
) -> dict[str, Any]:
    """sensor_msgs/CompressedImage of `image`; see `encode_image`."""
    header = {"stamp": dict(stamp or {"sec": 0, "nanosec": 0}), "frame_id": frame_id}
    return {"header": header, "format": kind, "data": encode_image(image, kind)}


def read_color_message(message: Mapping[str, Any]) -> NDArray[np.uint8] | None:
    """The image in a CompressedImage, or None if it is empty. Raises the errors of `decode_image`."""
    data = message_bytes(message)
    return decode_image(data) if data else None


def read_depth_message(message: Mapping[str, Any]) -> NDArray[np.float32] | None:
    """The depth [m] in an Image or CompressedImage, or None if it is empty: float32, (height, width).

    Its data are a grey PNG of 16 bits in mm, or raw, 16UC1 in mm, 32FC1 in m, else `ProtocolError`. Pixels without a
    measurement are 0.
    """
    data = message_bytes(message)
    if not data:
        return None
    if data.startswith(_PNG):
        pixels = _decode(data)
        if pixels.dtype != np.uint16 or pixels.ndim != 2:
            raise ProtocolError(f"A depth image must be grey with 16 bits, not {pixels.dtype} of shape {pixels.shape}.")
    else:
        dtype = _PIXEL_DTYPES.get(str(message.get("encoding")))
        if dtype is None:
            known = ", ".join(_PIXEL_DTYPES)
            raise ProtocolError(f"A depth image must be a PNG or one of {known}, not {message.get('encoding')!r}.")
        order = ">" if message.get("is_bigendian") else "<"
        try:
            pixels = np.frombuffer(data, order + dtype).reshape(message["height"], -1)[:, : message["width"]]
        except (KeyError, TypeError, ValueError) as error:
            raise ProtocolError(f"A depth image must have height x width pixels: {error}.") from error
    # Not in place: uint16 cannot hold metres.
    metres: NDArray[np.float32] = pixels.astype(np.float32) / np.float32(1000.0 if pixels.dtype.kind == "u" else 1.0)
    return np.nan_to_num(metres, copy=False, nan=0.0, posinf=0.0, neginf=0.0)


def depth_message(
    depth: NDArray[np.float32], frame_id: str = "", stamp: Mapping[str, int] | None = None
) -> dict[str, Any]:
    """sensor_msgs/Image, 32FC1, of `depth` [m]. Shape: (height, width)."""
    header = {"stamp": dict(stamp or {"sec": 0, "nanosec": 0}), "frame_id": frame_id}
    height, width = depth.shape
    raw = {"height": height, "width": width, "encoding": "32FC1", "is_bigendian": 0, "step": 4 * width}
    return {"header": header, **raw, "data": depth.astype("<f4").tobytes()}


def resized(image: NDArray[Any], height: int, width: int, *, smooth: bool) -> NDArray[Any]:
    """An image (h, w, channels) in another size; `smooth` averages pixels, else the nearest counts."""
    if not smooth:
        rows, columns = ((np.arange(to) * of) // to for to, of in zip((height, width), image.shape, strict=False))
        return np.asarray(image[rows][:, columns])
    pillow = _pillow()
    return np.asarray(pillow.fromarray(np.ascontiguousarray(image)).resize((width, height), pillow.Resampling.BOX))


def message_bytes(message: Mapping[str, Any]) -> bytes:
    """The data of an image message, `bytes` or base64 text; `ProtocolError` for anything else."""
    data = message.get("data", b"")
    if isinstance(data, (bytes, bytearray, memoryview)):
        return bytes(data)
    try:
        return base64.b64decode(data, validate=True)
    except (TypeError, ValueError) as error:  # binascii.Error is a ValueError
        raise ProtocolError(f"data of an image must be bytes or base64: {error}.") from error


def _decode(data: bytes) -> NDArray[Any]:
    if not data.startswith((_PNG, _JPEG)):
        raise ProtocolError(f"An image must be a PNG or JPEG file, not one that begins with {data[:8]!r}.")
    pillow = _pillow()
    try:
        with pillow.open(io.BytesIO(data)) as image:
            wide = image.mode.startswith("I")
            array = np.asarray(image.convert("RGB") if image.mode in ("P", "CMYK", "1") else image)
    # Pillow raises SyntaxError for a broken PNG, and DecompressionBombError for an image that would fill the memory.
    except (OSError, SyntaxError, ValueError, pillow.DecompressionBombError) as error:
        raise ProtocolError(f"An image cannot be read: {error}.") from error
    return array.astype(np.uint16) if wide else array


def _pillow() -> Any:
    try:
        return importlib.import_module("PIL.Image")
    except ImportError as error:
        raise MissingExtra("PIL", "video", "Sending camera images") from error
