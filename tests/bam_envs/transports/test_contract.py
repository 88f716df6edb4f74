"""Every transport keeps the same promises."""

from bam_envs.serve.env_server import EnvServer
from bam_envs.serve.tcp_server import TcpServer
from bam_envs.testing import TransportContract
from bam_envs.transports.fake import FakeTransport
from bam_envs.transports.local import LocalTransport
from bam_envs.transports.tcp import TcpTransport
from bam_envs.transports.transport import Transport


class TestLocalTransport(TransportContract):
    def make(self, env) -> Transport:
        return LocalTransport(env)


class TestFakeTransport(TransportContract):
    def make(self, env) -> Transport:
        return FakeTransport(env)


class TestTcpTransport(TransportContract):
    def make(self, env) -> Transport:
        self.server = TcpServer(EnvServer(env))
        self.server.start()
        return TcpTransport(self.server.url)

    def finish(self) -> None:
        self.server.close()
