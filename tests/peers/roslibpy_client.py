"""roslibpy, as it comes, as a client of the rosbridge server at the URL given: prints what came of it as JSON.

In a process of its own: it takes the default transport, of which a process has one at most.
"""

import json
import sys
import threading
import time

import roslibpy

LIMIT = 10


class Box:
    """Waits for one value."""

    def __init__(self):
        self._event, self.value = threading.Event(), None

    def put(self, value):
        self.value = value
        self._event.set()

    def get(self):
        if not self._event.wait(LIMIT):
            raise TimeoutError("nothing came")
        return self.value


def ping_pong(ros):
    box = Box()
    pong, ping = roslibpy.Topic(ros, "/pong", "std_msgs/String"), roslibpy.Topic(ros, "/ping", "std_msgs/String")
    pong.subscribe(box.put)
    while box.value is None:
        ping.publish({"data": "from roslibpy: é€𝄞"})
        time.sleep(0.02)
    pong.unsubscribe()
    ping.unadvertise()
    return box.get()["data"]


def call(ros, name, kind, request):
    try:
        return dict(roslibpy.Service(ros, name, kind).call(request, timeout=LIMIT))
    except roslibpy.core.ServiceException as error:
        return {"error": str(error)}


def call_when_there(ros, name, kind, request):
    """Two connections are served in no order: the offer may come after the call."""
    deadline = time.monotonic() + LIMIT
    while "error" in (answer := call(ros, name, kind, request)) and time.monotonic() < deadline:
        time.sleep(0.05)
    return answer


def states(ros):
    box = Box()
    topic = roslibpy.Topic(ros, "/gripper/joint_states", "sensor_msgs/JointState")
    topic.subscribe(box.put)
    message = box.get()
    topic.unsubscribe()
    return {"name": message["name"], "position": message["position"]}


def throttled(ros):
    box, times = Box(), []

    def note(_):
        times.append(time.monotonic())
        if len(times) == 6:
            box.put(times)

    options = {"throttle_rate": 100, "queue_length": 1}
    topic = roslibpy.Topic(ros, "/gripper/joint_states", "sensor_msgs/JointState", **options)
    topic.subscribe(note)
    first, *_, last = box.get()
    topic.unsubscribe()
    return 1000 * (last - first)


def provided(ros, url):
    service = roslibpy.Service(ros, "/roslibpy/flip", "std_srvs/SetBool")

    def flip(request, response):
        response.update(success=not request["data"], message="flipped")
        return True

    service.advertise(flip)
    other = connect(url)
    answer = call_when_there(other, "/roslibpy/flip", "std_srvs/SetBool", {"data": False})
    other.close()
    service.unadvertise()
    return answer


def connect(url):
    ros = roslibpy.Ros(url)
    ros.run(timeout=LIMIT)
    return ros


def main(url):
    if "--transport=asyncio" in sys.argv:
        roslibpy.set_default_transport("asyncio")
    ros = connect(url)
    results = {
        "topics": ping_pong(ros),
        "service": call(ros, "/robot/set", "std_srvs/SetBool", {"data": True}),
        "unknown": call(ros, "/nope", "std_srvs/Trigger", {}),
        "plain": states(ros),
        "throttled": throttled(ros),
        "provided": provided(ros, url),
        "time": sorted(ros.get_time()) if "--rosapi" in sys.argv else None,
    }
    print(json.dumps(results), flush=True)
    ros.terminate()


main(sys.argv[1])
