"""An S3 service on this computer, and a proxy that cuts connections to it."""

import contextlib
import logging
import socket
import threading
import urllib.request

import pytest


@contextlib.contextmanager
def environment(endpoint):
    """The environment variables of a user of the service."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("AWS_PROFILE", "AWS_SESSION_TOKEN", "AWS_ENDPOINT_URL_S3", "AWS_CA_BUNDLE", "AWS_REGION"):
            patch.delenv(name, raising=False)
        known = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_EC2_METADATA_DISABLED": "true"}
        for name, value in {**known, "AWS_ENDPOINT_URL": endpoint}.items():
            patch.setenv(name, value)
        clear = pytest.importorskip("s3fs").S3FileSystem.clear_instance_cache
        clear()  # of another environment's
        yield
        clear()


@pytest.fixture(scope="module", name="bucket")
def bucket_fixture():
    """Address of an empty bucket behind ``AWS_ENDPOINT_URL``."""
    s3fs = pytest.importorskip("s3fs")
    server = pytest.importorskip("moto.server").ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    logging.getLogger("werkzeug").setLevel(logging.ERROR)
    server.start()
    host, port = server.get_host_and_port()
    endpoint = f"http://{host}:{port}"
    try:
        urllib.request.urlopen(f"{endpoint}/moto-api/reset", data=b"").close()  # other modules' buckets in this process
        with environment(endpoint):
            s3fs.S3FileSystem().mkdir("bam-lab")
            yield "s3://bam-lab"
    finally:
        server.stop()


class Proxy:
    """Passes connections on to the service, and cuts as many answers as `cuts` after `after` bytes."""

    def __init__(self, target, after, cuts):
        self.target, self.after, self.cuts, self.lock = target, after, cuts, threading.Lock()
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = "http://{}:{}".format(*self.listener.getsockname())
        self.threads, self.sockets = [], [self.listener]
        self._start(self._accept)

    def _start(self, do, *arguments):
        thread = threading.Thread(target=do, args=arguments, daemon=True)
        self.threads.append(thread)
        thread.start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, server = self.listener.accept()[0], socket.create_connection(self.target)
                self.sockets += [client, server]
                self._start(self._pass, client, server, False)
                self._start(self._pass, server, client, True)

    def _pass(self, source, target, watched):
        passed = 0
        with contextlib.suppress(OSError):
            while data := source.recv(2**16):
                passed += len(data)
                with self.lock:
                    cut = watched and self.cuts > 0 and passed > self.after
                    self.cuts -= cut
                if cut:
                    break
                target.sendall(data)
        end(source, target)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        end(*self.sockets)
        for thread in self.threads:
            thread.join()
        for one in self.sockets:
            one.close()


def end(*sockets):
    for one in sockets:
        with contextlib.suppress(OSError):
            one.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def answering(status, code):
    """Endpoint of a service that gives every request the same error."""
    body = f"<Error><Code>{code}</Code><Message>no</Message></Error>".encode()
    head = f"HTTP/1.1 {status} X\r\nContent-Type: application/xml\r\nContent-Length: {len(body)}\r\n"
    listener = socket.create_server(("127.0.0.1", 0))

    def serve(client):
        with contextlib.suppress(OSError), client:
            data = b""
            while more := client.recv(2**16):
                data += more
                if b"\r\n\r\n" in data:
                    client.sendall(f"{head}Connection: close\r\n\r\n".encode() + (b"" if data[:4] == b"HEAD" else body))
                    return

    def accept():
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=serve, args=(listener.accept()[0],), daemon=True).start()

    threading.Thread(target=accept, daemon=True).start()
    try:
        yield "http://{}:{}".format(*listener.getsockname())
    finally:
        end(listener)
        listener.close()
