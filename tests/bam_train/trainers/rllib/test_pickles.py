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

from bam_train.compat.rllib.pickles import (
    Record,
    RefusedPickle,
    dtype_of,
    read_outline,
    read_record,
    read_state,
    unpacked_array,
)
from bam_train.compat.rllib.records import class_name, space_of
from bam_train.errors import FormatError

READERS = [read_state, read_record]


class Call:
    """Pickles as a call."""

    def __init__(self, function, *args):
        self.call = (function, args)

    def __reduce__(self):
        return self.call


def dumped(value, protocol=5):
    return pickle.dumps(value, protocol)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("protocol", [4, 5])
@pytest.mark.parametrize("dtype", ["f4", "f8", "i4", "i8", "u1", "?", ">f4"])
def test_states(reader, protocol, dtype):
    state = {
        "weights": np.arange(6).reshape(2, 3).astype(dtype),
        "scalar": np.array([3]).astype(dtype)[0],
        "transposed": np.arange(6).reshape(2, 3).astype(dtype).T,
        "strided": np.arange(6).astype(dtype)[::2],
        "plain": [1, 2.5, "text", b"bytes", None, True, (1, {2}), 10**30],
    }
    found = reader(dumped(state, protocol))
    for name in ("weights", "transposed", "strided"):
        np.testing.assert_array_equal(found[name], state[name])
        assert found[name].dtype.newbyteorder("=") == state[name].dtype.newbyteorder("=")
    assert (found["scalar"], found["plain"]) == (state["scalar"], state["plain"])


@pytest.mark.parametrize("reader", READERS)
def test_ordered_and_default_dicts_become_plain(reader):
    state = collections.OrderedDict(b=1, a=collections.defaultdict(None, {"c": 2}))
    found = reader(dumped(state))
    assert found == {"b": 1, "a": {"c": 2}}
    assert (list(found), type(found), type(found["a"])) == (["b", "a"], dict, dict)


PAYLOADS = [
    (os.system, "posix.system"),
    (subprocess.Popen, "subprocess.Popen"),
    (eval, "builtins.eval"),
    (getattr, "builtins.getattr"),
    (__import__, "builtins.__import__"),
    (io.open, "io.open"),
    (np.load, "numpy.load"),
    (pickle.loads, "_pickle.loads"),
]


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(("function", "name"), PAYLOADS, ids=[name for _, name in PAYLOADS])
@pytest.mark.parametrize("protocol", [4, 5])
def test_calls_are_refused_by_name(reader, function, name, protocol):
    with pytest.raises(RefusedPickle) as error:
        reader(dumped({"weights": [1, Call(function, "exit 7")]}, protocol))
    assert error.value.name == name
    assert str(error.value) == f"names {name}, which is not read without running it"


def test_nothing_is_called(tmp_path):
    mark = tmp_path / "mark"
    for reader in READERS:
        with pytest.raises(RefusedPickle):
            reader(dumped(Call(os.system, f"touch {mark}")))
    assert not mark.exists()


def test_objects_of_rllib_are_refused_among_states():
    with pytest.raises(RefusedPickle, match=r"^names gymnasium\.spaces\.box\.Box, which is not read"):
        read_state(dumped(spaces.Box(-1, 1)))


@pytest.mark.parametrize(
    "space",
    [
        spaces.Box(-1, 1, (2, 3), np.float32),
        spaces.Box(np.array([0, -np.inf]), np.array([1, np.inf]), dtype=np.float64),
        spaces.Discrete(3),
        spaces.Discrete(3, start=-1),
        spaces.MultiDiscrete([2, 3]),
        spaces.MultiBinary(4),
        spaces.MultiBinary([2, 3]),
        spaces.Dict({"b": spaces.Discrete(2), "a": spaces.Box(0, 255, (3,), np.uint8)}),
    ],
    ids=str,
)
@pytest.mark.parametrize("seeded", [False, True])
def test_spaces_out_of_records(space, seeded):
    if seeded:
        space.seed(0)
        space.sample()
    record = read_record(dumped(space))
    assert isinstance(record, Record)
    assert class_name(record) == f"{type(space).__module__}.{type(space).__name__}"
    assert space_of(record) == space


@pytest.mark.parametrize("space", [spaces.Tuple([spaces.Discrete(2)]), spaces.Sequence(spaces.Discrete(2))], ids=str)
def test_other_spaces(space):
    with pytest.raises(FormatError, match=f"^a space of kind {type(space).__module__}.{type(space).__name__} is not"):
        space_of(read_record(dumped(space)))


def test_a_number_is_not_spread_over_any_shape():
    record = read_record(dumped(spaces.Box(-1, 1, (2,), np.float32)))
    record.state["_shape"] = (10**12,)
    with pytest.raises(FormatError, match=r"bounds of shapes \(2,\) and \(2,\) for shape \(1000000000000,\)"):
        space_of(record)


def test_a_space_in_itself():
    record = read_record(dumped(spaces.Dict({"a": spaces.Discrete(2)})))
    record.state["spaces"]["a"] = record
    with pytest.raises(FormatError, match=r"^the fields of a Dict space do not make one"):
        space_of(record)


def test_records_of_classes_and_calls():
    found = read_record(b"\x80\x04cray.rllib.core.x\nThing\n(K\x01K\x02tR}(X\x01\x00\x00\x00aK\x03ub.")
    assert (found.name, found.args, found.attributes) == ("ray.rllib.core.x.Thing", (1, 2), {"a": 3})
    assert class_name(read_record(b"\x80\x04cray.rllib.core.x\nThing\n.")) == "ray.rllib.core.x.Thing"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is not a whole pickle of RLlib's: pickle exhausted before seeing STOP"),
        (b"not a pickle", "is not a whole pickle of RLlib's: "),
        (dumped({"a": np.zeros(100)})[:-50], "is not a whole pickle of RLlib's: "),
        (b"\x80\x04P1\n.", "has the instruction PERSID, which RLlib does not write"),
        (b"\x80\x04K\x01Q.", "has the instruction BINPERSID, which RLlib does not write"),
        (b"\x80\x04\x82\x01.", "has the instruction EXT1, which RLlib does not write"),
        (b"\x80\x02K\x01r" + struct.pack("<I", 2**31) + b".", "numbers a value 2147483648 after 3 instructions"),
        (b"\x80\x04(iposix\nsystem\n.", "has the instruction INST, which RLlib does not write"),
        (dumped(range(3)), "names builtins.range, which is not read without running it"),
        (dumped(np.array([[1], [1, 2]], object)), "names numpy.dtype('O8'), which is not read without running it"),
        (dumped(np.zeros(2, "f4,i4")), "names numpy.dtype('V8'), which is not read without running it"),
        (dumped(np.array(["a"])), "names numpy.dtype('U1'), which is not read without running it"),
    ],
)
@pytest.mark.parametrize("reader", READERS)
def test_damage_and_what_is_no_state(reader, data, message):
    with pytest.raises(FormatError) as error:
        reader(data)
    assert str(error.value).startswith(message)


def test_an_array_takes_no_more_memory_than_its_file():
    call = Call(np.ndarray, (10**12,))
    for reader in READERS:
        with pytest.raises(RefusedPickle, match=r"names numpy\.ndarray called"):
            reader(dumped(call))
        with pytest.raises(FormatError):
            reader(dumped(np.zeros(3)).replace(b"K\x03\x85", b"K\x7f\x85"))


DTYPE = b"cnumpy\ndtype\nX\x02\x00\x00\x00u1K\x00K\x01\x87R"


@pytest.mark.parametrize(
    "data",
    [
        b"\x80\x04cnumpy._core.numeric\n_frombuffer\n(J\xff\xff\xff\x7f"
        + DTYPE
        + b"J\xff\xff\xff\x7f\x85X\x01\x00\x00\x00CtR.",
        b"\x80\x04cnumpy._core.multiarray\nscalar\n" + DTYPE + b"J\xff\xff\xff\x7f\x86R.",
    ],
    ids=["array", "number"],
)
@pytest.mark.parametrize("reader", READERS)
def test_a_number_does_not_become_so_many_zeros(reader, data):
    with pytest.raises(RefusedPickle, match=r"^names an array whose data are a int, which is not read"):
        reader(data)


@pytest.mark.parametrize("reader", READERS)
def test_lists_that_are_many_more_written_out(reader):
    value, itself = ["a"], []
    for _ in range(40):
        value = [value, value]
    itself.append([itself])
    with pytest.raises(FormatError, match=r"^has more than 10000000 values$"):
        reader(dumped({"a": value}))
    with pytest.raises(FormatError, match=r"^holds a list within itself$"):
        reader(dumped({"a": itself}))


def test_an_outline_takes_any_name_and_calls_none(tmp_path):
    mark = tmp_path / "mark"
    found = read_outline(dumped({"class": range(3), "env": "Pendulum-v1", "more": Call(os.system, f"touch {mark}")}))
    assert (found["env"], found["class"].name, found["more"].name) == ("Pendulum-v1", "builtins.range", "posix.system")
    assert not mark.exists()
    value = ["a"]
    for _ in range(40):
        value = [value, value]
    with pytest.raises(FormatError, match=r"^has more than 10000000 values$"):
        read_outline(dumped(Call(os.system, value)))


def test_names_are_said_in_letters():
    with pytest.raises(RefusedPickle, match=r"^names evil\?line\.A\?\[31m, which is not read"):
        read_record(b"\x80\x04\x8c\x09evil\nline\x8c\x06A\x1b[31m\x93.")


def test_functions_of_the_reader_keep_their_state():
    data = b"\x80\x04cnumpy._core.numeric\n_frombuffer\nN}(X\x0c\x00\x00\x00__defaults__)u\x86b."
    with pytest.raises(RefusedPickle, match="the state of a function"):
        read_state(data)


def test_too_many_instructions(monkeypatch):
    monkeypatch.setattr("bam_train.compat.rllib.pickles._MOST_INSTRUCTIONS", 10)
    with pytest.raises(FormatError, match=r"^has more than 10 instructions"):
        read_state(dumped(list(range(20))))


def test_too_many_names(monkeypatch):
    monkeypatch.setattr("bam_train.compat.rllib.pickles._MOST_NAMES", 1)
    data = b"\x80\x04(cray.rllib.a\nA\ncray.rllib.b\nB\ncray.rllib.c\nC\nl."
    with pytest.raises(FormatError, match=r"^has more than 1 names"):
        read_record(data)


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
        (
            packed(np.array([Call(os.system, "exit 7")], object)),
            "a packed array cannot be read: Object arrays",
        ),
        ("!", "a packed array cannot be read: "),
        (base64.b64encode(b"not zlib").decode(), "a packed array cannot be read: "),
        (packed(np.zeros(100))[:40], "a packed array cannot be read: "),
    ],
)
def test_packed_arrays_that_are_none(text, message):
    with pytest.raises(FormatError) as error:
        unpacked_array(text)
    assert str(error.value).startswith(message)


def test_a_packed_array_that_unpacks_to_more_than_there_is(monkeypatch):
    monkeypatch.setattr("bam_train.compat.rllib.pickles._MOST_NPY", 1000)
    with pytest.raises(FormatError, match="not whole, or more than 1000 bytes"):
        unpacked_array(packed(np.zeros(10_000)))


def test_dtypes():
    assert dtype_of(read_record(dumped(np.dtype("f4")))) == np.float32
    with pytest.raises(FormatError, match="is not a dtype"):
        dtype_of("nothing")
