"""A TCP connection to a server, and the reasons why there is none, or no WebSocket."""

import asyncio
import socket
import ssl

from bam_envs.core.errors import NoServer
from bam_envs.core.location import LiveRobot, is_loopback
from bam_envs.rosbridge.endpoint import Address

_HOST_MISMATCH = (62, 64)  # X509_V_ERR_HOSTNAME_MISMATCH, X509_V_ERR_IP_ADDRESS_MISMATCH

AGENT_PORT = 9095
"""Default port of a live agent, which serves its robot there."""
_LAUNCH = "ros2 launch rosbridge_server rosbridge_websocket_launch.xml"


async def open_port(address: Address, timeout: float, *, stand_in: str = LiveRobot.stand_in) -> socket.socket:
    """A TCP connection to a server; `NoServer` gives the reason why there is none within `timeout` [s].

    `stand_in`: see `no_connection`.
    """
    opening = asyncio.get_running_loop().create_task(_open_tcp(address))
    try:
        await asyncio.wait((opening,), timeout=timeout)
        await asyncio.sleep(0)  # on a busy computer, the answer may have come together with the end of the time
        if not opening.done():
            raise asyncio.TimeoutError
        return opening.result()
    except (OSError, asyncio.TimeoutError) as error:
        raise NoServer(address.url, no_connection(address, error, timeout, stand_in=stand_in)) from error
    finally:
        opening.cancel()


async def _open_tcp(address: Address) -> socket.socket:
    loop = asyncio.get_running_loop()
    try:  # a number needs no look-up, which takes a thread, and on a busy computer its time
        infos = socket.getaddrinfo(*address[:2], type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST)
    except socket.gaierror:
        infos = await loop.getaddrinfo(*address[:2], type=socket.SOCK_STREAM)
    for place, (family, kind, protocol, _, target) in enumerate(infos):
        plain = socket.socket(family, kind, protocol)
        plain.setblocking(False)
        try:
            await loop.sock_connect(plain, target)
            return plain
        except BaseException as error:
            plain.close()
            if not isinstance(error, OSError) or place == len(infos) - 1:
                raise
    raise OSError("the name has no address")


def no_connection(
    address: Address,
    error: OSError | asyncio.TimeoutError,
    timeout: float,
    start: str = "",
    *,
    stand_in: str = LiveRobot.stand_in,
) -> str:
    """The reason why no TCP or TLS connection was made within `timeout` [s].

    `start` says how to start a server; or `stand_in` is the command that serves a simulated robot, without a port.
    """
    if isinstance(error, ssl.SSLCertVerificationError):
        reason = error.verify_message.rstrip(".")
        if error.verify_code in _HOST_MISMATCH:
            return f"the certificate is not for {address.host!r}: {reason}. Use a name that is in it."
        remedy = "Give the file of the authority that signed it as ca_file (--ca-file)."
        return f"the certificate is not trusted: {reason}. {remedy}"
    if isinstance(error, ssl.SSLError):
        return f"TLS failed: {error.reason}. If the server has no TLS, use ws://."
    if isinstance(error, TimeoutError | asyncio.TimeoutError):
        return f"no connection within {timeout:.1f} s. Is the address right, is the machine on, is a firewall between?"
    if isinstance(error, socket.gaierror):
        example = " In examples it stands for the robot's computer." if address.host in ("robot", "gpu") else ""
        return f"the name {address.host!r} is not known: {error.strerror}. Try the IP address.{example}"
    if isinstance(error, ConnectionRefusedError):
        here = f"Start one with `{stand_in} --port {address.port}` or `{_launch(address)}`."
        if address.port == AGENT_PORT:
            start = start or f"{AGENT_PORT} is the port of bam-agent: does it run there? {here}"
        return f"refused: nothing listens there. Is the port open? {start or here}"
    if isinstance(error, ConnectionError):
        hint = "If the server has no TLS, use ws://." if address.secure else "Is it the right port?"
        return f"the connection was cut while it was made. {hint}"
    return f"cannot be reached: {error.strerror or error}."


def _launch(address: Address) -> str:
    """The command that starts a rosbridge server there; one for this computer listens to nobody else."""
    near = f" address:={'127.0.0.1' if address.host == 'localhost' else address.host}"
    return f"{_LAUNCH} port:={address.port}{near if is_loopback(address.host) else ''}"


def silent(address: Address, timeout: float) -> str:
    """The reason why there is no WebSocket where a port is open that did not answer within `timeout` [s]."""
    hint = " Does it speak TLS? If not, use ws://." if address.secure else ""
    text = f"the port is open, and what listens there is silent for {timeout:.1f} s. Is it a rosbridge server?"
    return f"{text}{hint}"


def no_websocket(reason: object) -> str:
    """The text about a server that sent something else than the answer to a WebSocket's opening handshake."""
    hint = "If it has TLS, use wss://; if it is the port of bam-serve --tcp, tcp://."
    return f"something listens there that is no WebSocket server ({reason}). {hint}"


def http_refusal(status: int, body: bytes, token: str | None) -> str:
    """The reason why a web server did not open a WebSocket, by its response; `token` is what it was shown."""
    said = body[:300].decode(errors="replace").strip()
    if status in (400, 403, 429, 503) and said.endswith("."):  # a server of ours gives its reason
        return f"the server refuses this client (HTTP {status}): {said}"
    if status in (401, 403):
        why = "the token was refused" if token else "the server asks for a token, and none was given"
        return f"{why} (HTTP {status}). Give the server's token (--token-file)."
    return f"a web server answers there, with HTTP {status}: no WebSocket. Is it the right port?"
