"""Every space through every transport of ours, bit for bit, there and back."""

import json
from contextlib import closing
from typing import Any

import numpy as np
from gymnasium import Space, spaces
from gymnasium.vector.utils import concatenate, create_empty_array
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from bam_envs.remote.serve.env_server import EnvServer
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.remote.wire.gymapi_codec import EnvCodec
from bam_envs.remote.wire.transport import EnvSpecMessage
from bam_envs.remote.wire.values import exact, pack, tree_from_json, tree_to_json
from bam_envs.testing.transports import MirrorEnv, assert_same_value
from tests.bam_envs.remote.test_gymapi_codec import action_there, result_back

DTYPES = ("float16", "float32", "float64", "uint8", "int8", "int32", "int64", "uint64")


@st.composite
def boxes(draw: st.DrawFn) -> spaces.Box:
    dtype = np.dtype(draw(st.sampled_from(DTYPES)))
    shape = draw(st.one_of(st.just(()), array_shapes(max_dims=3, max_side=3)))
    if dtype.kind != "f":
        limits = np.iinfo(dtype)
        return spaces.Box(limits.min, limits.max, shape, dtype)  # type: ignore[arg-type]
    low, high = draw(st.sampled_from([(-np.inf, np.inf), (-1, 1), (0, np.inf), (-np.inf, 0)]))
    return spaces.Box(low, high, shape, dtype)  # type: ignore[arg-type]


@st.composite
def multi_discretes(draw: st.DrawFn) -> spaces.MultiDiscrete:
    shape = draw(array_shapes(max_dims=2, max_side=3))
    nvec = draw(arrays(np.int64, shape, elements=st.integers(1, 9)))
    return spaces.MultiDiscrete(nvec, start=draw(arrays(np.int64, shape, elements=st.integers(-9, 9))))


@st.composite
def texts(draw: st.DrawFn) -> spaces.Text:
    charset = "".join(sorted(draw(st.sets(st.characters(codec="utf-8"), min_size=1, max_size=5))))
    return spaces.Text(draw(st.integers(1, 9)), min_length=0, charset=charset)


IMAGES = st.sampled_from([(8, 9), (9, 8, 1), (8, 8, 3), (8, 10, 4)]).map(lambda s: spaces.Box(0, 255, s, np.uint8))
POSES = st.sampled_from([("position", "orientation"), ("position", "orientation", "gripper_width")]).map(
    lambda keys: spaces.Dict({k: spaces.Box(-9, 9, {"position": (3,), "orientation": (4,)}.get(k, ())) for k in keys})
)
LEAVES = st.one_of(
    boxes(),
    IMAGES,
    POSES,
    st.builds(lambda n, start: spaces.Discrete(n, start=start), st.integers(1, 99), st.integers(-9, 9)),
    multi_discretes(),
    st.builds(spaces.MultiBinary, st.one_of(st.integers(1, 9), st.lists(st.integers(1, 4), min_size=2, max_size=3))),
    texts(),
)
SPACES = st.recursive(
    LEAVES,
    lambda inner: st.one_of(
        st.dictionaries(st.text(max_size=5), inner, max_size=3).map(lambda some: spaces.Dict(list(some.items()))),  # type: ignore[arg-type]
        st.lists(inner, max_size=3).map(spaces.Tuple),
        st.builds(lambda one, stack: spaces.Sequence(one, stack=stack and has_length(one)), inner, st.booleans()),
    ),
    max_leaves=5,
)


def has_length(space: Space[Any]) -> bool:
    """Whether a stack of `space` shows how many there are: an empty Dict or Tuple has nothing to stack."""
    inner = getattr(space, "spaces", None)
    if inner is None:
        return not isinstance(space, spaces.Sequence) or has_length(space.feature_space)
    return bool(inner) and all(has_length(one) for one in (inner.values() if isinstance(inner, dict) else inner))


def values(space: Space[Any]) -> st.SearchStrategy[Any]:
    """Values of `space`: every float and integer that it holds, infinities where its bounds are."""
    return _VALUES[type(space)](space)


def _box_values(space: spaces.Box) -> st.SearchStrategy[Any]:
    dtype = space.dtype
    if np.prod(space.shape) > 64:
        return st.integers(0, 2**32).map(lambda seed: _sample(space, seed))
    if dtype.kind != "f":
        return arrays(dtype, space.shape, elements=st.integers(int(np.iinfo(dtype).min), int(np.iinfo(dtype).max)))
    low, high = (float(bound.flat[0]) for bound in (space.low, space.high))
    bounds = {"min_value": None if np.isinf(low) else low, "max_value": None if np.isinf(high) else high}
    numbers = st.floats(**bounds, allow_nan=False, width=8 * dtype.itemsize)
    inside = numbers.filter(lambda number: low <= number <= high)
    return arrays(dtype, space.shape, elements=inside)


def _items(space: spaces.Sequence) -> st.SearchStrategy[Any]:
    items = st.lists(values(space.feature_space), max_size=3).map(tuple)
    return items.map(lambda some: _stacked(space.feature_space, some)) if space.stack else items


def _stacked(feature: Space[Any], items: tuple[Any, ...]) -> Any:
    empty = create_empty_array(feature, len(items))
    return concatenate(feature, items, empty) if items else empty


_VALUES: dict[type, Any] = {
    spaces.Box: _box_values,
    spaces.Discrete: lambda space: st.integers(int(space.start), int(space.start + space.n) - 1).map(np.int64),
    spaces.MultiDiscrete: lambda space: st.integers(0, 2**32).map(lambda seed: _sample(space, seed)),
    spaces.MultiBinary: lambda space: arrays(np.int8, space.shape, elements=st.integers(0, 1)),
    spaces.Text: lambda space: st.text(st.sampled_from(space.character_list), max_size=space.max_length),
    spaces.Dict: lambda space: st.fixed_dictionaries({key: values(one) for key, one in space.spaces.items()}),
    spaces.Tuple: lambda space: st.tuples(*[values(one) for one in space.spaces]),
    spaces.Sequence: _items,
}


def _sample(space: Space[Any], seed: int) -> Any:
    space.seed(seed)
    return space.sample()


@st.composite
def cases(draw: st.DrawFn) -> tuple[Space[Any], list[Any]]:
    """A space and some values of it."""
    space = draw(SPACES)
    return space, [draw(values(space)) for _ in range(3)]


def there_and_back(transport, env, values):
    transport.connect()
    transport.reset(seed=1)
    for value in values:
        assert_same_value(transport.step(value)[0], value, "observation")
        assert_same_value(env.seen[-1], value, "action")


@given(cases())
def test_tcp(case):
    space, values = case
    env = MirrorEnv(space)
    with TcpServer(EnvServer(env)) as server, closing(TcpTransport(server.url)) as transport:
        there_and_back(transport, env, values)


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(cases())
def test_gymapi(case):
    space, values = case
    codec = EnvCodec(EnvSpecMessage("x", space, space))
    for value in values:
        assert_same_value(action_there(codec, value), value, "action")
        assert_same_value(result_back(codec, (value, 0.1, True, False, {}))[0], value, "observation")


@given(cases())
def test_strict_json(case):
    space, values = case
    for value in values:
        text = json.dumps(tree_to_json(pack(space, value)), allow_nan=False)
        assert_same_value(exact(space, tree_from_json(json.loads(text))), value, "value")
