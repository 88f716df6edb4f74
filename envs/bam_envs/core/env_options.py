"""The options of an environment, checked before it is made: names with the closest match, and kinds of values.

They are the arguments of its task's constructor. Kinds are checked because any text in place of a flag, even
``parity="false"``, would count as True.
"""

import inspect
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, UnknownName
from bam_envs.core.robot import CameraSpec
from bam_envs.core.validation import check

CAMERA_OPTIONS: dict[str, Any] = {
    "camera": None,
    "image_size": 64,
    "depth": False,
    "segmentation": False,
    "looks": "fixed",
}
"""Options of an environment with cameras, and their defaults."""
_PIXELS = "whole numbers of pixels from 8 to 1280: one, or width and height, such as 640x480"
_Size = Annotated[int, Meta(ge=8, le=1280, description=_PIXELS)]
_Sizes = Annotated[list[_Size], Meta(min_length=2, max_length=2, description=_PIXELS)]


def constructor_options(task: type) -> dict[str, Any]:
    """The options of a task's class with their defaults, including those that it passes on to its base classes."""
    options: dict[str, Any] = {}
    for kind in task.__mro__:
        if "__init__" in vars(kind):
            parameters = inspect.signature(vars(kind)["__init__"]).parameters
            defaults = {name: one.default for name, one in parameters.items() if one.kind is one.KEYWORD_ONLY}
            options = {**defaults, **options}
            if not any(one.kind is one.VAR_KEYWORD for one in parameters.values()):
                break
    return options


def in_our_words(name: str) -> str:
    """The name of an option with robo-gym's name of a joint instead of ROS's: ``fix_shoulder_pan`` is ``fix_base``."""
    return name.replace("shoulder_pan", "base").replace("shoulder_lift", "shoulder")


def require_known(env_id: str, options: Mapping[str, Any], given: Iterable[str], others: Iterable[str]) -> None:
    """Refuse an option that is not in `options`; `others` may be the closest match too.

    Raises:
        UnknownName: It carries the closest match.
    """
    for name in given:
        if name not in options:
            raise UnknownName(f"argument of {env_id}", name, {*options, *others}, meant=in_our_words(name))


def require_kinds(env_id: str, options: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Refuse a value of another kind than its default in `options`; unknown names are ignored.

    Raises:
        InvalidValue: A flag is neither True nor False, or a number is expected.
    """
    for name, value in given.items():
        default = options.get(name)
        if isinstance(default, bool) and not isinstance(value, (bool, np.bool_)):
            raise InvalidValue(f"{name}= of {env_id} must be True or False, not {value!r}.")
        if isinstance(default, float) and (not isinstance(value, Real) or isinstance(value, bool)):
            raise InvalidValue(f"{name}= of {env_id} must be a number, not {value!r}.")


def finite_numbers(value: Any, size: int, name: str) -> NDArray[np.float64]:
    """`value`, an option called `name` in errors, as an array. Shape: (size,).

    Raises:
        InvalidValue: It is not `size` finite numbers.
    """
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.array(np.nan)
    if numbers.shape != (size,) or not np.isfinite(numbers).all():
        raise InvalidValue(f"{name} must be {size} finite numbers, not {value!r}.")
    return numbers


def read_cameras(env_id: str, known: Sequence[str], given: Mapping[str, Any]) -> tuple[CameraSpec, ...]:
    """The cameras that the options in `given` ask for; () without the option ``camera``.

    Raises:
        UnknownName: The environment has no such camera.
        InvalidValue: An option has a value of the wrong kind, or no effect.
    """
    camera, options = given.get("camera"), {**CAMERA_OPTIONS, **given}
    if camera is None:
        changed = [name for name in CAMERA_OPTIONS if given.get(name, CAMERA_OPTIONS[name]) != CAMERA_OPTIONS[name]]
        if changed:
            raise InvalidValue(f"{changed[0]}= of {env_id} is for images; give camera= too, such as {known[0]!r}.")
        return ()
    names = check([camera] if isinstance(camera, str) else camera, list[str], f"camera= of {env_id}")
    for name in names:
        if name not in known:
            raise UnknownName(f"camera of {env_id}", name, known)
    if not names or len(set(names)) != len(names):
        raise InvalidValue(f"camera= of {env_id} must be one or more different names, not {names!r}.")
    width, height = _size(options["image_size"], f"image_size= of {env_id}")
    check(options["looks"], Literal["fixed", "random"], f"looks= of {env_id}")
    return tuple(CameraSpec(name, width, height, options["depth"], options["segmentation"]) for name in names)


def _size(value: Any, name: str) -> tuple[int, int]:
    """Width and height of ``64``, ``[640, 480]`` or ``640x480``."""
    parts = value.split("x") if isinstance(value, str) else value
    numbers = (
        [int(one) if isinstance(one, str) and one.isdecimal() else one for one in parts]
        if isinstance(parts, (list, tuple))
        else [parts, parts]
    )
    try:
        width, height = check(numbers, _Sizes, name)
    except InvalidValue as error:
        raise InvalidValue(f"{name}: expected {_PIXELS}, found {value!r}") from error
    return width, height
