"""NumPy arrays as columns of Parquet files and back, bit for bit.

One number a step is a plain column; several, of any shape, are a list of fixed size; pictures are PNG.
"""

from __future__ import annotations

import io
from typing import Any

import numpy as np

from bam_train.data.recorded_episode import Array

Arrow = Any
"""An array, table or type of pyarrow."""


def to_arrow(array: Array, *, is_image: bool = False) -> Arrow:
    """A column of `array`, whose first axis is the steps."""
    import pyarrow as pa

    if is_image:
        return pa.array([{"bytes": png_of(picture), "path": None} for picture in array], image_type())
    if array.dtype.kind in "UO":
        return pa.array([str(one) for one in array], pa.string())
    size = int(np.prod(array.shape[1:]))
    flat = pa.array(np.ascontiguousarray(array).reshape(-1))
    return flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)


def from_arrow(column: Arrow, shape: tuple[int, ...] | None, dtype: np.dtype[Any] | None = None) -> Array:
    """The array of a column; `shape` is that of one step, None for that of the column.

    Raises:
        ValueError: The column has other numbers than `shape` and `dtype` say.
    """
    import pyarrow as pa

    if isinstance(column, pa.ChunkedArray):
        column = column.combine_chunks()
    count = len(column)
    if column.null_count:
        raise ValueError("it has empty places")
    if pa.types.is_struct(column.type):
        return np.stack([pixels_of(one["bytes"].as_py()) for one in column])
    if pa.types.is_string(column.type):
        return np.array(column.to_pylist(), dtype=str)
    if pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type):
        shape = (column.type.list_size if pa.types.is_fixed_size_list(column.type) else -1,) if shape is None else shape
        column = column.flatten()
    array: Array = column.to_numpy(zero_copy_only=False)
    if dtype is not None and array.dtype != dtype:
        raise ValueError(f"it has numbers of dtype {array.dtype}, expected {dtype}")
    return np.array(array.reshape(count, *(shape or ())))


def image_type() -> Arrow:
    """The type of a column of pictures, as Hugging Face ``datasets`` has it."""
    import pyarrow as pa

    return pa.struct([("bytes", pa.binary()), ("path", pa.string())])


def png_of(picture: Array) -> bytes:
    """A picture (height, width, 1, 3 or 4) of uint8 as PNG, which keeps every pixel."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(picture[..., 0] if picture.shape[-1] == 1 else picture).save(buffer, "PNG", compress_level=1)
    return buffer.getvalue()


def pixels_of(data: bytes) -> Array:
    """The picture of a PNG. Shape: (height, width, 1, 3 or 4)."""
    from PIL import Image

    with Image.open(io.BytesIO(data)) as image:
        pixels = np.array(image)
    return pixels[..., None] if pixels.ndim == 2 else pixels
