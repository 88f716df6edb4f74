"""Answering service requests off the network thread: always, whatever the handler does."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from bam_envs.core.errors import BamEnvsError
from bam_envs.rosbridge.bus import UNKNOWN_CALLER, Handler

_LOG = logging.getLogger(__name__)
_MOST_AT_ONCE = 64


class Answerer:
    """Runs each handler in a thread of its own.

    Args:
        name: For the threads' names.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._threads: set[threading.Thread] = set()
        self._lock = threading.Lock()

    def answer(
        self, request: Mapping[str, Any], handler: Handler | None, respond: Callable[[dict[str, Any]], None]
    ) -> None:
        """Start answering. `respond` gets the response, in another thread; where there is no handler, in this one."""
        response = {"op": "service_response", "service": request.get("service"), "id": request.get("id")}
        if handler is None:
            respond({**response, "values": f"Service {request.get('service')} is not served here", "result": False})
            return
        with self._lock:
            busy = len(self._threads) >= _MOST_AT_ONCE
            if not busy:
                thread = threading.Thread(
                    target=self._run, args=(request, handler, respond, response), name=self._name, daemon=True
                )
                self._threads.add(thread)
                thread.start()
        if busy:
            respond({**response, "values": f"{_MOST_AT_ONCE} requests are being answered already", "result": False})

    def join(self, timeout: float) -> None:
        """Wait for the handlers that still run, but not for ever and not for oneself."""
        deadline = time.monotonic() + timeout
        with self._lock:
            running = self._threads - {threading.current_thread()}
        for thread in running:
            thread.join(max(0.0, deadline - time.monotonic()))

    def _run(
        self,
        request: Mapping[str, Any],
        handler: Handler,
        respond: Callable[[dict[str, Any]], None],
        response: dict[str, Any],
    ) -> None:
        try:
            respond({**response, **_outcome(request, handler)})
        except BamEnvsError as error:
            self._respond_failure(error, respond, response)
        finally:
            with self._lock:
                self._threads.discard(threading.current_thread())

    def _respond_failure(
        self, error: BamEnvsError, respond: Callable[[dict[str, Any]], None], response: dict[str, Any]
    ) -> None:
        # The response itself was not sendable, or the caller is gone.
        try:
            respond({**response, "values": str(error), "result": False})
        except BamEnvsError as gone:
            _LOG.warning("%s: the response could not be sent: %s", response["service"], gone)


def _outcome(request: Mapping[str, Any], handler: Handler) -> dict[str, Any]:
    args = request.get("args")
    try:
        return {"values": dict(handler(args if isinstance(args, Mapping) else {}, UNKNOWN_CALLER)), "result": True}
    except BamEnvsError as error:
        return {"values": str(error), "result": False}
    except Exception as error:  # a handler is foreign code, and the caller waits for an answer in every case
        _LOG.exception("%s: the handler failed", request.get("service"))
        return {"values": f"{type(error).__name__}: {error}", "result": False}
