"""The places of a server's clients: some are kept for higher roles, and who says nothing gives way."""

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Protocol, TypeVar

from bam_envs.rosbridge.tokens import ROLES, Role, network_of

_KEPT = 4
"""A quarter of the places is kept for each higher role."""


class Client(Protocol):
    """A client, as far as its place is concerned."""

    host: str
    """Its network address."""
    role: Role | None
    """What it may do; None counts as the least role."""
    born: float
    """When it connected [s, monotonic]."""
    spoke: float
    """When it last sent a message after its admission [s, monotonic]; 0 if it has sent none."""


AnyClient = TypeVar("AnyClient", bound=Client)


def places(most: int, role: Role, known: Iterable[Role]) -> int:
    """How many of `most` places are open to a role, if the server has tokens of the roles `known`."""
    return most - most // _KEPT * sum(ROLES.index(one) > ROLES.index(role) for one in set(known))


def who_leaves(newcomer: Client, present: Sequence[AnyClient]) -> AnyClient | None:
    """The client that gives its place to a newcomer where all are taken; None if everybody may stay.

    Nobody leaves for a lower role. Who never sent a message leaves first, the oldest of the address with the most of
    them. Then an address with at least two more clients than that of the newcomer gives up the one that has been silent
    for longest: whoever drives is the last one of these.
    """
    rank = _rank(newcomer)
    rivals = [one for one in present if _rank(one) <= rank]
    among = [one for one in rivals if not one.spoke] or rivals
    counts = Counter(network_of(one.host) for one in among)
    if not counts:
        return None
    where, most = counts.most_common(1)[0]
    leaves = min((one for one in among if network_of(one.host) == where), key=lambda one: one.spoke or one.born)
    return None if leaves.spoke and most < counts[network_of(newcomer.host)] + 2 else leaves


def _rank(client: Client) -> int:
    return 0 if client.role is None else ROLES.index(client.role)
