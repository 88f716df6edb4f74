"""Nothing that a pickle names is looked up or called, whatever it is."""

import base64
import collections
import io
import os
import pickle
import struct
import subprocess
import zlib

import numpy as np
import pytest
from gymnasium import spaces

from bam_train.errors import FormatError
from bam_train.trainers.rllib.rllib_state import RefusedPickle, Unread, read_state, unpacked_array


class Call:
    """Pickles as a call."""

    def __init__(self, function, *args):
        self.call = (function, args)

    def __reduce__(self):
        return self.call


def dumped(value, protocol=5):
    return pickle.dumps(value, protocol)


@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i4", "i8", "u1", "?", ">f4"])
def test_states(protocol, dtype):
    state = {
        "weights": np.arange(6).reshape(2, 3).astype(dtype),
        "scalar": np.array([3]).astype(dtype)[0],
        "transposed": np.arange(6).reshape(2, 3).astype(dtype).T,
        "strided": np.arange(6).astype(dtype)[::2],
        "plain": [1, 2.5, "text", b"bytes", None, True, (1, {2}), 10**30],
    }
    found = read_state(dumped(state, protocol))
    for name in ("weights", "transposed", "strided"):
        np.testing.assert_array_equal(found[name], state[name])
        assert found[name].dtype.newbyteorder("=") == state[name].dtype.newbyteorder("=")
    assert (found["scalar"], found["plain"]) == (state["scalar"], state["plain"])


def test_ordered_and_default_dicts_become_plain():
    state = collections.OrderedDict(b=1, a=collections.defaultdict(None, {"c": 2}))
    found = read_state(dumped(state))
    assert found == {"b": 1, "a": {"c": 2}}
    assert (list(found), type(found), type(found["a"])) == (["b", "a"], dict, dict)


FUNCTIONS = [os.system, subprocess.Popen, eval, getattr, __import__, io.open, np.load, pickle.loads]


@pytest.mark.parametrize("function", FUNCTIONS)
@pytest.mark.parametrize("protocol", [4, 5])
def test_calls_are_refused_by_name(function, protocol):
    with pytest.raises(RefusedPickle) as error:
        read_state(dumped({"weights": [1, Call(function, "exit 7")]}, protocol))
    name = f"{function.__module__}.{function.__qualname__}"
    assert str(error.value) == f"names {name}, which is not read without running it"


def test_nothing_is_called(tmp_path):
    mark = tmp_path / "mark"
    with pytest.raises(RefusedPickle):
        read_state(dumped(Call(os.system, f"touch {mark}")))
    found = read_state(dumped({"a": Call(os.system, f"touch {mark}"), "b": range(3), "c": 1}), skip_objects=True)
    assert (type(found["a"]), type(found["b"]), found["c"]) == (Unread, Unread, 1)
    assert not mark.exists()


DTYPE = b"cnumpy\ndtype\nX\x02\x00\x00\x00u1K\x00K\x01\x87R"
MANY_ZEROS = "names an array whose data are a int, which is not read"  # as many as the number says


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is not a whole pickle of RLlib's: pickle exhausted before seeing STOP"),
        (b"not a pickle", "is not a whole pickle of RLlib's: "),
        (dumped({"a": np.zeros(100)})[:-50], "is not a whole pickle of RLlib's: "),
        (b"\x80\x04K\x01Q.", "is not a whole pickle of RLlib's: A load persistent id instruction"),
        (b"\x80\x04\x82\x01.", "is not a whole pickle of RLlib's: unregistered extension code 1"),
        (b"\x80\x02K\x01r" + struct.pack("<I", 2**31) + b".", "numbers a value 2147483648 after 3 instructions"),
        (dumped(range(3)), "names builtins.range, which is not read without running it"),
        (dumped(spaces.Box(-1, 1)), "names gymnasium.spaces.box.Box, which is not read without running it"),
        (b"\x80\x04\x8c\x09evil\nline\x8c\x06A\x1b[31m\x93.", "names evil?line.A?[31m, which is not read"),
        (b"\x80\x04cnumpy._core.multiarray\nscalar\n" + DTYPE + b"J\xff\xff\xff\x7f\x86R.", MANY_ZEROS),
        (
            b"\x80\x04cnumpy._core.numeric\n_frombuffer\n(J\xff\xff\xff\x7f"
            + DTYPE
            + b"J\xff\xff\xff\x7f\x85X\x01\x00\x00\x00CtR.",
            MANY_ZEROS,
        ),
        (dumped(Call(np.ndarray, (10**12,))), "names numpy.ndarray called"),
        (dumped(np.zeros(3)).replace(b"K\x03\x85", b"K\x7f\x85"), ""),  # more numbers than there are data
        (dumped(np.array([[1], [1, 2]], object)), "names numpy.dtype('O8'), which is not read without running it"),
        (dumped(np.zeros(2, "f4,i4")), "names numpy.dtype('V8'), which is not read without running it"),
        (dumped(np.array(["a"])), "names numpy.dtype('U1'), which is not read without running it"),
    ],
)
def test_damage_and_what_is_no_state(data, message):
    with pytest.raises(FormatError) as error:
        read_state(data)
    assert str(error.value).startswith(message)


def test_lists_that_are_many_more_written_out():
    value, itself = ["a"], []
    for _ in range(40):
        value = [value, value]
    itself.append([itself])
    with pytest.raises(FormatError, match=r"^has more than 10000000 values$"):
        read_state(dumped({"a": value}))
    with pytest.raises(FormatError, match=r"^holds a list within itself$"):
        read_state(dumped({"a": itself}))


def test_stand_ins_cannot_be_changed():
    data = b"\x80\x04cnumpy._core.numeric\n_frombuffer\nN}(X\x0c\x00\x00\x00__defaults__)u\x86b."
    with pytest.raises(FormatError):
        read_state(data)
    np.testing.assert_array_equal(read_state(dumped(np.arange(3))), np.arange(3))


def packed(array):
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return base64.b64encode(zlib.compress(file.getvalue())).decode()


def test_packed_arrays():
    array = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(unpacked_array(packed(array)), array)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (packed(np.array([Call(os.system, "exit 7")], object)), "a packed array cannot be read: Object arrays"),
        ("!", "a packed array cannot be read: "),
        (base64.b64encode(b"not zlib").decode(), "a packed array cannot be read: "),
        (packed(np.zeros(100))[:40], "a packed array cannot be read: "),
    ],
)
def test_packed_arrays_that_are_none(text, message):
    with pytest.raises(FormatError) as error:
        unpacked_array(text)
    assert str(error.value).startswith(message)
