"""No packet of the ROS 2 that these tests run leaves this machine: the kernel says where its sockets are bound."""

import contextlib
import os
from pathlib import Path

LOOPBACK, DISCOVERY = "127.0.0.1", "239.255.0.1"


def udp_sockets(pid):
    links = []
    for entry in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(FileNotFoundError):  # closed meanwhile
            links.append(os.readlink(entry))
    inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
    rows = [line.split() for line in Path(f"/proc/{pid}/net/udp").read_text().splitlines()[1:]]
    return {address(row[1]) for row in rows if row[9] in inodes}, inodes


def address(text):
    number = bytes.fromhex(text.split(":")[0])[::-1]
    return ".".join(map(str, number))


def test_every_udp_socket_is_bound_to_loopback(rosbridge, robot_node):
    for pid in (rosbridge.pid, robot_node.pid):
        bound, _ = udp_sockets(pid)
        assert LOOPBACK in bound
        assert bound <= {LOOPBACK, DISCOVERY}


def test_discovery_has_joined_its_group_on_loopback_only(multicast_interfaces, rosbridge, robot_node):
    before, now = multicast_interfaces
    assert "lo" in now()
    assert now() - before <= {"lo"}


def test_there_is_no_other_udp_over_ipv6(rosbridge, robot_node):
    for pid in (rosbridge.pid, robot_node.pid):
        _, inodes = udp_sockets(pid)
        rows = [line.split() for line in Path(f"/proc/{pid}/net/udp6").read_text().splitlines()[1:]]
        assert not [row for row in rows if row[9] in inodes]
