"""A workspace with a window: memory stays flat, the sink sees every time once and in order."""

import pytest

from bam_train.errors import LoopError
from bam_train.loop import Agent, TemporalAgent, Workspace


class Sink:
    """Keeps the pieces, and checks that each begins where the one before ended."""

    def __init__(self):
        self.times, self.pieces, self.next = {}, [], 0

    def __call__(self, first_time, variables):
        assert first_time == self.next
        self.next = first_time + max(len(array) for array in variables.values())
        self.pieces.append(first_time)
        for name, array in variables.items():
            self.times.setdefault(name, []).extend(array.tolist())


class Count(Agent):
    """x at t is t; y is x of the time before."""

    def __init__(self, kind):
        super().__init__()
        self.kind = kind

    def forward(self, t, **kwargs):
        self.set(("x", t), self.kind([t, -t], "int64"))
        before = 0.0 if t == 0 else float(self.get(("x", t - 1))[0])
        self.set(("y", t), self.kind([[before], [before]]))


@pytest.mark.parametrize("window", [2, 3, 50, 64, 65, 100])
def test_every_time_goes_to_the_sink_once_and_in_order(kind, window):
    sink = Sink()
    ws = Workspace(window=window, sink=sink)
    TemporalAgent(Count(kind))(ws, n_steps=1000)
    assert ws.time_size() == 1000
    assert 1000 - ws.first_time >= window
    kept = ws["x"].tolist()
    assert kept == [[t, -t] for t in range(ws.first_time, 1000)]
    assert sink.times["x"] + kept == [[t, -t] for t in range(1000)]
    assert sink.next == ws.first_time
    ws.flush()
    assert sink.times["x"] == [[t, -t] for t in range(1000)]
    assert sink.times["y"] == [[[max(0.0, t - 1.0)]] * 2 for t in range(1000)]
    assert (ws.first_time, ws.time_size(), list(ws.keys())) == (0, None, [])


def test_memory_stays_flat(kind):
    ws, most = Workspace(window=10), 0
    for t in range(2000):
        ws.set("x", t, kind([float(t)]))
        most = max(most, len(ws["x"]))
        assert ws.get("x", t - min(t, 9)).tolist() == [float(t - min(t, 9))]
    assert most <= 10 + 64
    assert ws.time_size() == 2000


def test_pieces_are_few_and_own_their_memory(kind):
    pieces = []
    ws = Workspace(window=4, sink=lambda first, variables: pieces.append((first, variables["x"])))
    for t in range(500):
        ws.set("x", t, kind([t], "int64"))
    assert len(pieces) <= 500 // 60
    for t in range(500, 1000):
        ws.set("x", t, kind([0], "int64"))
    flat = [value for first, piece in pieces for value in piece.flatten().tolist()]
    assert flat[:500] == list(range(500))


def test_reading_and_writing_what_has_left_the_window(kind):
    ws = Workspace(window=2)
    for t in range(200):
        ws.set("x", t, kind([t], "int64"))
    first = ws.first_time
    assert first > 0
    kept = f"it has times {first} to 199; earlier ones have left the window."
    for use in (lambda: ws.get("x", 0), lambda: ws.set("x", 0, kind([0], "int64"))):
        with pytest.raises(LoopError) as error:
            use()
        assert str(error.value) == f"'x' is not written at t=0; {kept}"
    with pytest.raises(LoopError) as error:
        ws.get("x", 200)
    assert str(error.value) == f"'x' is not written at t=200; {kept}"
    with pytest.raises(LoopError) as error:
        ws.get_time_truncated("x", 0, 199)
    assert str(error.value) == f"'x' has lost t=0: times before {first} have left the window."
    for use in (
        lambda: ws.get_time_truncated_workspace(0, 199),
        lambda: ws.subtime(0, 199),
        lambda: ws.copy_n_last_steps(1),
        lambda: ws.copy_time(0, 199, 1),
    ):
        with pytest.raises(LoopError, match=r"left the window|first"):
            use()
    assert ws.get_time_truncated("x", first, first + 2).flatten().tolist() == [first, first + 1]
    assert ws.subtime(198, 200)["x"].flatten().tolist() == [198, 199]


def test_a_variable_that_begins_late(kind):
    sink = Sink()
    ws = Workspace(window=2, sink=sink)
    for t in range(300):
        ws.set("x", t, kind([t], "int64"))
        if t >= 250:
            ws.set("late", t, kind([t], "int64"))
    assert len(ws["late"]) == len(ws["x"])
    ws.flush()
    assert sink.times["x"] == [[t] for t in range(300)]
    assert sink.times["late"][-50:] == [[t] for t in range(250, 300)]
    assert set(map(tuple, sink.times["late"][:-50])) <= {(0,)}


def test_flush_begins_a_new_episode_at_time_zero(kind):
    sink = Sink()
    ws, loop = Workspace(window=3, sink=sink), TemporalAgent(Count(kind))
    loop(ws, n_steps=100)
    ws.flush()
    assert (sink.next, len(sink.times["x"])) == (100, 100)
    sink.next = 0
    loop(ws, n_steps=5)
    ws.flush()
    assert sink.times["x"][100:] == [[t, -t] for t in range(5)]
    pieces = len(sink.pieces)
    ws.flush()
    assert len(sink.pieces) == pieces


def test_clear_gives_nothing_to_the_sink(kind):
    sink = Sink()
    ws = Workspace(window=3, sink=sink)
    ws.set("x", 0, kind([1], "int64"))
    ws.clear()
    assert sink.pieces == []
    assert ws.first_time == 0


def test_windows_of_columns_are_counted_from_time_zero(kind):
    ws = Workspace(window=2)
    for t in range(200):
        ws.set("x", t, kind([t, -t], "int64"))
    piece = ws.select_subtime(kind([198, 197], "int64"), 2)
    kind.check(piece["x"], [[198, -197], [199, -198]], "int64")
    with pytest.raises(LoopError, match="window"):
        ws.select_subtime(kind([0, 0], "int64"), 2)


@pytest.mark.parametrize("window", [1, 0, -3])
def test_a_window_holds_the_last_time_and_the_one_before(window):
    with pytest.raises(LoopError) as error:
        Workspace(window=window)
    assert str(error.value) == f"window: expected at least 2 times (the last and the one before), found {window}."
