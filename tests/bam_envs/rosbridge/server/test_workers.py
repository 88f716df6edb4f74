import threading

from bam_envs.rosbridge.threads import Workers

DEADLINE = 10.0


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


def test_a_handler_that_hangs_does_not_keep_it_from_closing():
    workers, gate, started = Workers(1, "hung"), threading.Event(), threading.Event()
    workers.submit(lambda: (started.set(), gate.wait(DEADLINE)))
    assert started.wait(DEADLINE)
    workers.close(patience=0.0)
    (thread,) = [one for one in threading.enumerate() if one.name == "hung-0"]
    assert thread.daemon
    gate.set()
    thread.join(DEADLINE)
    assert not thread.is_alive()
