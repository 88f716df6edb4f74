"""A bus inside this process, and what tests say on it."""

import threading

import gymnasium as gym
import pytest

import bam_envs  # noqa: F401 - registers the environments
from bam_envs.core.errors import BamEnvsError
from bam_envs.remote.serve.serve_options import ServeOptions
from bam_envs.remote.serve.served_environment import ServedEnvironment
from bam_envs.ros.freshness import Tagger
from bam_envs.rosbridge.bus import Caller


class MemoryBus:
    """Hands messages over at once, in the thread that sends; what listeners raise is kept."""

    def __init__(self):
        self.advertised, self.listeners, self.services, self.leavers = {}, {}, {}, []
        self.published, self.refusals, self.reserved = [], [], {}
        self.news = threading.Condition()
        self.fails = None

    def advertise(self, topic, kind, *, latch=False):
        self.advertised[topic] = kind

    def publish(self, topic, message):
        if self.fails is not None:
            raise self.fails
        with self.news:
            self.published.append((topic, message))
            self.news.notify_all()

    def publish_all(self, messages):
        for topic, message in messages:
            self.publish(topic, message)

    def subscribe(self, topic, kind, listener):
        self.listeners.setdefault(topic, []).append((kind, listener))
        return lambda: self.listeners[topic].remove((kind, listener))

    def serve(self, service, kind, handler):
        self.services[service] = (kind, handler)

    def reserve(self, topic, check):
        self.reserved[topic] = check

    def on_leave(self, callback):
        self.leavers.append(callback)

    def close(self):
        pass

    def say(self, topic, message, caller="a"):
        """A client's message; the text of the refusal, or None."""
        who = Caller(caller, f"{caller}:1") if caller else Caller("")
        try:
            for _, listener in self.listeners.get(topic, []):
                listener(message, who)
        except BamEnvsError as error:
            return f"{type(error).__name__}: {error}"
        return None

    def leave(self, caller):
        for callback in self.leavers:
            callback(Caller(caller, f"{caller}:1"))

    def wait_for(self, topic, condition=lambda message: True, timeout=10.0):
        """The newest message on `topic` that fits, or one that comes in time."""

        def found():
            return next((one for name, one in reversed(self.published) if name == topic and condition(one)), None)

        with self.news:
            assert self.news.wait_for(lambda: found() is not None, timeout), f"nothing that fits on {topic}"
            return found()


@pytest.fixture
def bus():
    return MemoryBus()


@pytest.fixture
def serve_env():
    """Start a `ServedEnvironment`; what it told is in its ``lines``."""
    served = []

    def start(env_id="bam/pick-v0", env=None, **options):
        env, lines = env or gym.make(env_id, disable_env_checker=True), []
        served.append(ServedEnvironment(env, ServeOptions(**{"port": 0, **options}), lines.append))
        served[-1].lines = lines
        return served[-1].__enter__()

    yield start
    for one in served:
        one.close()
        one.close()


@pytest.fixture
def tagger():
    return Tagger()
