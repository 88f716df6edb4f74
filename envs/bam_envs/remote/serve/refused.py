"""What a rosbridge server that is not ours does not carry of what is offered through it, and what to do about that.

One kind of server says so in a `status` message with the id of the declaration. The other kinds say nothing, and what
they carry is what rosapi lists.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from bam_envs.core.errors import RemoteError
from bam_envs.rosbridge.client import RosbridgeLink

_WITHIN, _AGAIN, _ANSWER = 3.0, 0.2, 3.0
"""Longest that a ROS graph takes to know of what was declared, time between two looks, longest answer [s]."""
_UNLISTED = "rosapi does not list it"


class Refusals:
    """Collects what the server of `link`, which is not connected yet, says of its declarations.

    Attributes:
        unchecked: Whether the server said nothing, and has no rosapi that could be asked; known after `look`.
    """

    def __init__(self, link: RosbridgeLink) -> None:
        self._link, self._said = link, dict[str, str]()
        self.unchecked = False
        link.on_status(self._hear)

    def _hear(self, status: Mapping[str, Any]) -> None:
        if status.get("level") == "error":
            self._said[str(status.get("id"))] = str(status.get("msg"))

    def look(self) -> dict[str, tuple[str, str]]:
        """What is not carried: name -> type and reason. Waits until the server has answered.

        Raises:
            LinkLost: The link dropped.
        """
        unlisted = self._unlisted()
        said = {one: reason for one, reason in self._said.items() if one in self._link.declared}
        self.unchecked = unlisted is None and not said
        reasons = {**dict.fromkeys(unlisted or (), _UNLISTED), **said}
        return {name: (kind, reasons[one]) for one, (name, kind) in self._link.declared.items() if one in reasons}

    def _unlisted(self) -> list[str] | None:
        """Ids of the declarations that rosapi does not know after a while; None if there is no rosapi."""
        deadline = time.monotonic() + _WITHIN
        while True:
            try:
                known = {
                    what: self._link.call(f"/rosapi/{what}", f"rosapi/{what.capitalize()}", {}, _ANSWER).get(what)
                    for what in ("topics", "services")
                }
            except RemoteError:
                return None
            names = {name for listed in known.values() if isinstance(listed, list) for name in listed}
            missing = [one for one, (name, _) in self._link.declared.items() if name not in names]
            if not missing or time.monotonic() > deadline:
                return missing
            time.sleep(_AGAIN)


def refusal_lines(url: str, refused: Mapping[str, tuple[str, str]]) -> list[str]:
    """One line for each package, for people: what is not carried, why, and what helps."""
    packages: dict[str, list[str]] = {}
    for name, (kind, _) in refused.items():
        packages.setdefault(kind.partition("/")[0], []).append(name)
    lines = []
    for package, names in packages.items():
        whole = ", ".join(f"{name} ({refused[name][0]})" for name in names)
        lines.append(f"{url} does not carry {whole}: {refused[names[0]][1]}. {_remedy(package)}")
    return lines


def _remedy(package: str) -> str:
    if package == "bam_msgs":
        how = "Build it beside the bridge from ros/bam_msgs of this project (colcon build --packages-select bam_msgs)"
    else:
        how = f"Install {package} beside the bridge (apt install ros-$ROS_DISTRO-{package.replace('_', '-')})"
    return f"{how}, source it, and start the bridge again."
