"""The front process of a live agent: everything that listens, so that no client can make a tick late.

It serves the robot over rosbridge, for programs that take over; the agent socket, for the console and the programs
`bam-agent` and `bam-push`; and the pages of the console.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec

from bam_envs.core.errors import BamEnvsError
from bam_envs.rosbridge.server import BridgeServer, Page, ServerOptions, read_pages
from bam_envs.rosbridge.server.site import Site
from bam_envs.rosbridge.tokens import TokenFile, Tokens
from bam_train.agent.agent_messages import Channel, Front, Listening, adopted
from bam_train.agent.front.agent_socket import AgentSocket
from bam_train.agent.front.camera_feed import CameraFeed
from bam_train.agent.front.hub import AgentHub
from bam_train.agent.front.robot_front import FrontProcess
from bam_train.agent.remote.agent_protocol import PATH
from bam_train.errors import BamTrainError
from bam_train.files.log_lines import begin_log
from bam_train.signals import ignore

CONSOLE = Path(__file__).parents[1] / "console"
"""The files of the web console: plain HTML, CSS and modules."""
LIBRARIES = ("uplot", "three")
"""Folders into which the installation puts what draws (``hatch_build.py``); without them the console only writes."""
_BARE, _PLACED = b"from 'three';", b"from './three.core.min.js';"
"""How a module of three.js names its library, and how a page finds it without an import map, which is inline script."""


def console_pages() -> Mapping[str, Page]:
    """The pages of the console by their path; ``/`` is the console."""
    pages = read_pages(CONSOLE)
    for name in LIBRARIES:
        if (folder := CONSOLE / name).is_dir():
            pages |= read_pages(folder)
    return {path: page._replace(body=page.body.replace(_BARE, _PLACED)) for path, page in pages.items()}


def main() -> None:
    """Run the process; its argument is the number of the socket that the resident left open."""
    ignore(signal.SIGINT)  # the resident ends it
    begin_log("bam-agent")
    end = adopted(int(sys.argv[1]))
    about = Front.from_bytes(end.recv(2**20))
    options = about.agent
    receivers: list[Callable[[Any], None]] = []
    channel = Channel(end, lambda message: receivers[0](message), lambda: front.stop())
    try:
        front = FrontProcess(about, channel.send)
        hub = AgentHub(front)
        console, pictures = AgentSocket(hub), CameraFeed(front.cameras(), front.seen())
        # A client without a place may stop the robot.
        site = Site(console_pages(), {PATH: console.serve, "/camera": pictures.serve}, always=frozenset((PATH,)))
        tokens = Tokens(otherwise="administer") if options.token_file is None else TokenFile(options.token_file)
        network = ServerOptions(open_timeout=2.0, max_clients=64)
        where: Any = {"cert": options.cert, "key": options.key, "tokens": tokens, "site": site, "options": network}
        server = BridgeServer(options.bind, options.port, **where)
        server.start()
    except (BamEnvsError, BamTrainError) as error:
        end.send(msgspec.msgpack.encode(Listening(error=str(error))))
        return
    receivers.append(front.take)
    channel.start()
    hub.start()
    try:
        front.serve(server)
    finally:
        hub.close()
        server.close()
        console.close()
        pictures.close()


if __name__ == "__main__":
    main()
