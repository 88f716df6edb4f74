"""Contract tests for your own robots, tasks and transports: inherit, override `make`, run pytest.

::

    from bam_envs.testing import RobotContract, TaskContract, TransportContract

    class TestMyRobot(RobotContract):  # a TaskContract or LocalTaskContract likewise
        def make(self, num_robots):
            return MyRobot(num_robots)

    class TestMyTransport(TransportContract):
        def make(self, env):
            return MyTransport(address_of_a_server_of(env))

They need only NumPy and Gymnasium, and are for arms with the signals of `bam_envs.robots.ur5e`; for another robot,
override the hooks that name an arm. `DrivenRobot` simulates a live robot whose driver misbehaves.
"""

from bam_envs.testing.drivers import DrivenRobot
from bam_envs.testing.robots import ARM_HOME, RobotContract
from bam_envs.testing.tasks import LocalTaskContract, TaskContract
from bam_envs.testing.transports import TransportContract

__all__ = ["ARM_HOME", "DrivenRobot", "LocalTaskContract", "RobotContract", "TaskContract", "TransportContract"]
