"""Modes of `bam-deploy` that move no robot: the table of guards, the contract with a live robot, and the rehearsal."""

import json
from contextlib import closing
from typing import Any

from bam_envs.core.location import LiveRobot, Location
from bam_envs.core.registry import entry_of
from bam_envs.core.wording import as_flag
from bam_train.checkpoint import Checkpoint
from bam_train.cli.console import say, tell
from bam_train.cli.deploy import ANY_ROBOT, policy_server
from bam_train.cli.flags import DeployConfig
from bam_train.deploy.contract import check_contract
from bam_train.deploy.guard_table import guard_lines, in_force, read_guards
from bam_train.deploy.rehearsal import Rehearsal
from bam_train.environments import environment_of, make_env
from bam_train.errors import ContractRefused, SettingsError
from bam_train.evaluation import FIRST_SEED
from bam_train.policy import FrozenPolicy

LIVE_ONLY = (
    *("robot", "robot_name", "transport", "rate", "fast", "render", "wiggle", "motion", "stage", "i_know", "trials"),
    *("shadow", "unusual", "record", "print_guards", "print_contract", "ca_file", "token_file", "timeout", "keys"),
    *("allow_unsigned", "robot_model"),
)
"""Flags that a rehearsal has no use for."""


def print_guards(config: DeployConfig, checkpoint: Checkpoint, place: Location) -> int:
    """Print the guards between a live robot and the policy of `checkpoint`; nothing is connected."""
    env_id, env_kwargs = environment_of(checkpoint, config.env, arm=config.robot_model)
    if entry_of(env_id) is None:
        raise SettingsError(f"--print-guards: {env_id} has no robot, and so no guards")
    env = make_env(env_id, env_kwargs, place=place)
    robot: Any = env.unwrapped.robot  # type: ignore[attr-defined]
    guards = robot.guards()
    limits = in_force(guards, robot.limits, robot.spec)
    table = {"guards": guards, "limits": limits}
    tell(*([json.dumps(table)] if config.json else guard_lines(guards, limits)))
    env.close()  # type: ignore[no-untyped-call]
    return 0


def print_contract(config: DeployConfig, checkpoint: Checkpoint, place: LiveRobot) -> int:
    """Print the whole contract of `checkpoint` with the live robot at `place`; nothing moves."""
    made_for = environment_of(checkpoint, config.env, arm=config.robot_model)
    with closing(make_env(*made_for, place=place)) as env:
        contract = check_contract(checkpoint, env, place)
    tell(*([json.dumps(contract.to_json())] if config.json else contract.lines()))
    return ContractRefused.exit_status if contract.refused else 0


def rehearse(config: DeployConfig, link: str) -> int:
    """Rehearse the deployment in simulation, and report it."""
    for name in LIVE_ONLY:
        if getattr(config, name):
            trial = f". To practise a trial, start bam-serve, and give --robot {ANY_ROBOT} --stage trial"
            raise SettingsError(
                f"--rehearse simulates the robot, its link and its time; leave out {as_flag(name)}"
                f"{trial if name == 'stage' else ''}"
            )
    checkpoint = Checkpoint.open(config.checkpoint)
    server = policy_server(config)
    policy = FrozenPolicy.from_checkpoint(checkpoint, server)
    limits: Any = {"profile": config.profile, "guards": read_guards(config.guard)}
    with closing(Rehearsal(checkpoint, link, named=config.env, **limits)) as rehearsal:
        seed = FIRST_SEED if config.seed is None else config.seed
        report = rehearsal.run(
            policy if server is None else rehearsal.elsewhere(policy, seed),
            episodes=config.episodes,
            seed=seed,
            tell=lambda line: say(f"bam-deploy: {line}"),
        )
    tell(*([json.dumps(report.to_json(), allow_nan=False)] if config.json else report.lines()))
    return 0
