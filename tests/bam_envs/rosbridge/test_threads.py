import asyncio
import threading

import pytest

from bam_envs.rosbridge.threads import LoopThread, Workers

DEADLINE = 10.0


@pytest.fixture
def running():
    """A loop that runs until the test is over."""
    thread = LoopThread("test-loop")
    stop = []

    async def main(ready):
        stop.append(asyncio.Event())
        ready.set_result(None)
        await stop[0].wait()

    thread.start(main)
    yield thread
    thread.post(lambda: stop[0].set())
    thread.join()
    assert not thread.post(list)


def test_work_is_done_in_the_thread_and_what_it_raises_is_for_who_waits(running):
    assert running.do(lambda: threading.current_thread().name) == "test-loop"
    assert running.do(lambda: running.do(lambda: running.is_current))
    with pytest.raises(ZeroDivisionError):
        running.do(lambda: 1 // 0)
    assert running.do(lambda: 1) == 1


def test_without_a_loop_work_is_done_at_once():
    thread = LoopThread("never")
    assert thread.do(threading.current_thread) is threading.current_thread()
    assert not thread.post(list)
    thread.join()


def test_what_goes_wrong_at_the_start_is_raised_there():
    async def main(ready):
        raise OSError(98, "no")

    thread = LoopThread("wrong")
    with pytest.raises(OSError, match="no"):
        thread.start(main)
    thread.join()
    assert thread.was_started


def test_threads_are_started_as_they_are_needed_and_end():
    workers, gate, done = Workers(2, "w"), threading.Event(), threading.Semaphore(0)
    names = set()

    def work():
        names.add(threading.current_thread().name)
        assert gate.wait(DEADLINE)
        done.release()

    for _ in range(3):
        workers.submit(work)
    gate.set()
    for _ in range(3):
        assert done.acquire(timeout=DEADLINE)
    workers.close()
    assert names == {"w-0", "w-1"}
    assert not [one for one in threading.enumerate() if one.name in names]
