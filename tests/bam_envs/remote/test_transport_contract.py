"""Every transport keeps the same promises."""

from bam_envs.remote.serve.env_server import EnvServer, LocalTransport
from bam_envs.remote.serve.tcp_server import TcpServer
from bam_envs.remote.tcp_transport import TcpTransport
from bam_envs.remote.wire.transport import Transport
from bam_envs.testing import TransportContract


class TestLocalTransport(TransportContract):
    def make(self, env) -> Transport:
        return LocalTransport(env)


class TestTcpTransport(TransportContract):
    def make(self, env) -> Transport:
        self.server = TcpServer(EnvServer(env))
        self.server.start()
        return TcpTransport(self.server.url)

    def finish(self) -> None:
        self.server.close()
