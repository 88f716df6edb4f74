"""What the commands of `bam-robots` do."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bam_envs.core.errors import InvalidValue
from bam_train.cli.console import say, tell
from bam_train.files.place import Place

if TYPE_CHECKING:
    from collections.abc import Iterator

    from bam_envs.arms.capsules import Outline
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot_models import Description
    from bam_envs.robots.base_description import BaseDescription
    from bam_envs.ros.profile_tables import RobotProfile
    from bam_train.cli.arms.bam_robots import AddArmConfig, CheckArmConfig, ListArmsConfig, ProfileConfig
    from bam_train.cli.arms.live_graph import LiveGraph

_PICTURES = {".png": "PNG", ".jpg": "JPEG"}
_STRAY = 0.05
"""Distance from the links around it from which a capsule is no part of an arm [m]."""
_POSTURES = 2000  # in which kinematics are compared with MuJoCo's


def add(config: AddArmConfig) -> int | None:
    """Write the description of an arm."""
    from bam_envs.core.robot_models import ModelName, known_models
    from bam_envs.core.validation import check as check_value
    from bam_envs.robots.modelling.describe import as_toml, describe
    from bam_envs.robots.modelling.model_files import is_urdf

    if (config.mjcf is None) == (config.urdf is None):
        raise InvalidValue("Give one model of the arm: --mjcf FILE or --urdf FILE.")
    check_value(config.name, ModelName, "NAME")
    if config.site is not None and config.tip is not None:
        raise InvalidValue("--site and --tip name the same thing, the end of the arm; give one of them.")
    path = config.out / f"{config.name}.toml"
    if path.exists() and not config.force:
        raise InvalidValue(f"{path} exists; give another name, or --force to replace it.")
    if config.name in known_models() and not config.force:
        raise InvalidValue(
            f"{config.name} is a robot already, which this one would hide; give another name, or --force."
        )
    model = config.mjcf or config.urdf or ""
    if is_urdf(Path(model)) != (config.mjcf is None) and Path(model).is_file():
        tell(f"{model} is {'MJCF' if config.mjcf is None else 'a URDF'}, and is read as such")
    arm, notes = describe(config.name, model, config.gripper, config.site or config.tip, tell=say)
    Place(path).write(as_toml(arm, notes).encode())
    tell(f"wrote {path}: {arm.num_joints} joints, gripper {1000 * arm.gripper.open:.0f} mm, {_area(arm)}")
    if notes:
        tell("assumed, and written at its head:", *(f"  {note}" for note in notes))
    tell(
        "next:",
        f"  bam-robots check {config.name}",
        f"  bam-train --env bam/pick --robot-model {config.name} --algo ppo",
    )
    return None


def check(config: CheckArmConfig) -> int | None:
    """Show a robot."""
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot_models import Description, find_model
    from bam_envs.robots.base_description import base_model
    from bam_train.files.log_lines import aligned

    robot = find_model(config.name, Description)
    tell(f"{robot.name}: {robot.title}", "")
    if isinstance(robot, ArmDescription):
        table, facts = _joints(robot), _facts(robot)
    else:
        table, facts = _axes(base_model(robot)), _base_facts(base_model(robot))
    facts.append(("limits from", "; ".join(f"{name}: {text}" for name, text in robot.sources.items()), True))
    tell(*aligned(table), "", *aligned([[name, text] for name, text, _ in facts]))
    if config.picture is not None:
        _draw(robot, config.picture)
        tell(f"drawn in {config.picture}")
    return 0 if all(fits for *_, fits in facts) else 1


def _joints(arm: ArmDescription) -> list[list[str]]:
    """The joints of an arm, for `aligned`."""
    head = ["joint", "from", "to", "speed", "acceleration", "jerk", "torque", "home"]
    units = ["", "rad", "rad", "rad/s", "rad/s^2", "rad/s^3", "N m", "rad"]
    rows = [
        [row.name, *(f"{one:.4g}" for one in (row.low, row.high, row.velocity, row.acceleration, row.jerk, row.effort))]
        for row in arm.joints
    ]
    return [head, units, *([*row, f"{home:.3f}"] for row, home in zip(rows, arm.home, strict=True))]


def _axes(base: BaseDescription) -> list[list[str]]:
    """The speeds of a base, for `aligned`."""
    command = base.spec(with_scans=False).command
    rows = zip(command.labels, command.high, command.units, command.max_rate or (), strict=True)
    limits = [[name, f"{most:.4g} {unit}", f"{rate:.4g} {unit}^2"] for name, most, unit, rate in rows]
    return [["axis", "speed", "acceleration"], *limits]


def _base_facts(base: BaseDescription) -> list[tuple[str, str, bool]]:
    """What is to be said of a base: name, text, and whether it is as it should be."""
    body, foot = base.body, base.footprint
    shape = f"circle of {foot.radius:g} m" if foot.radius else f"{len(body.corners)} corners"
    length, width = body.front + body.back, body.reach(0.0, 1.0) + body.reach(0.0, -1.0)
    facts = [
        ("footprint", f"{shape}, {length:.3g} x {width:.3g} m, at most {body.size:.3f} m from its frame", True),
        ("drive", base.drive.kind, True),
    ]
    for scanner in body.scanners:
        (x, y, yaw), (low, high), bearings = scanner.pose, scanner.range, np.degrees(scanner.bearings)
        text = f"{len(bearings)} rays from {bearings[0]:.0f} to {bearings[-1]:.0f} degrees, {low:g} to {high:g} m, "
        text += f"at x {x:g}, y {y:g} m, yaw {np.degrees(yaw):.0f} degrees"
        facts.append((f"laser {scanner.name}", text, True))
    return facts if body.scanners else [*facts, ("lasers", "none: bam/avoidance needs one", True)]


def _facts(arm: ArmDescription) -> list[tuple[str, str, bool]]:
    """What is measured of an arm: name, text, and whether it is as it should be."""
    from bam_envs.arms.capsules import Outline
    from bam_envs.arms.work_area import uncovered

    chain, outline = arm.chain, Outline(arm.chain)
    rng = np.random.default_rng(0)
    q = chain.low + rng.random((_POSTURES, arm.num_joints)) * (chain.high - chain.low)
    reach = float(np.linalg.norm(chain.tool_position(q) - chain.placements[0, :3, 3], axis=1).max())
    off = _simulated_gap(arm, q)
    clear = float(min(outline.nearest(chain.home[None])[0], outline.lowest(chain.home[None])[0]))
    _, missed = uncovered(chain, outline, np.array(arm.workspace))
    share = float((outline.nearest(q) < 0.0).mean())
    flaw = _outline_flaw(arm, outline)
    turns = "position and turn of the gripper" if chain.turns else "position only: this arm cannot turn its gripper"
    return [
        ("reach", f"{reach:.3f} m from the first joint", True),
        ("kinematics", f"within {off:.1e} m of MuJoCo's in {_POSTURES} postures", off < 1e-9),
        ("tool", f"{turns}", True),
        ("gripper", f"opens to {1000 * arm.gripper.open:.0f} mm at {arm.gripper.speed:g} m/s", True),
        ("home pose", f"{clear:.3f} m from itself and from the table", clear > 0.0),
        (
            "outline",
            f"{len(arm.capsules)} capsules, {len(outline.pairs)} pairs; {share:.0%} of all postures touch{flaw}",
            not flaw,
        ),
        ("work area", _area(arm) + (f": not all of it is reached: {missed}" if missed else ""), not missed),
    ]


def _outline_flaw(arm: ArmDescription, outline: Outline) -> str:
    """What is wrong with the capsules: a gripper without any, collisions that are not found, a stray one; or ""."""
    from bam_envs.arms.capsules import MOST_FALSE, WHOLE, segment_distances

    if arm.num_joints + 1 not in outline.links:
        return "; the gripper has no capsule, so that nothing keeps it from the arm: add its shapes"
    seen = re.match(r"(\d+) of (\d+) collisions(?:.* ([\d.]+)% of the other)?", arm.sources.get("outline", ""))
    if seen and int(seen[1]) < WHOLE * int(seen[2]):
        return (
            f"; only {seen[1]} of {seen[2]} collisions of the arm with itself are found: add capsules where links meet"
        )
    if seen and float(seen[3] or 0.0) > MOST_FALSE:
        return f"; {seen[3]}% of the postures without a collision count as one: put two thin capsules for a thick one"
    start, end = np.moveaxis(outline.segments(arm.chain.home[None])[0], 1, 0)
    gaps = segment_distances(start[:, None], end[:, None], start, end) - outline.radius[:, None] - outline.radius
    gaps[(np.abs(np.subtract.outer(outline.links, outline.links)) > 2) | np.eye(len(gaps), dtype=bool)] = np.inf
    stray = [place for place, gap in enumerate(gaps.min(axis=1)) if gap > _STRAY]
    where = ", ".join(f"capsules[{place}] of link {outline.links[place]}" for place in stray)
    return f"; {where}: more than {100 * _STRAY:g} cm from the links around it; correct or remove it" if stray else ""


def _area(arm: ArmDescription) -> str:
    (x, y, z), (far, side, top) = arm.workspace
    return f"works from x {x:g} to {far:g}, y {y:g} to {side:g}, z {z:g} to {top:g} m"


def _simulated_gap(arm: ArmDescription, q: Any) -> float:
    """Greatest distance of the tool from where MuJoCo's kinematics have it [m]."""
    from bam_envs.robots.physics.arm_model import scene_spec
    from bam_envs.robots.physics.mujoco_batch import mujoco

    model = scene_spec(arm, with_object=False).compile()
    data, site = mujoco.MjData(model), model.site("tool").id
    places = []
    for joints in q:
        data.qpos[: len(joints)] = joints
        mujoco.mj_kinematics(model, data)
        places.append(data.site_xpos[site].copy())
    return float(np.abs(np.array(places) - arm.chain.tool_position(q)).max())


def _draw(description: Description, path: Path) -> None:
    """Write a picture of an arm in its home pose, on its table, or of a base among boxes."""
    from PIL import Image

    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot import Initial
    from bam_envs.robots.physics.kinematic_base import SimulatedBase
    from bam_envs.robots.physics.mujoco_arm import SimulatedArm

    if path.suffix.lower() not in _PICTURES:
        raise InvalidValue(f"--picture {path}: expected a name that ends in {' or '.join(_PICTURES)}.")
    robot: SimulatedArm | SimulatedBase
    start: dict[str, Any] = {"obstacle_pose": np.array([[[1.5, 0.5, 0.3], [-0.5, -1.5, 1.0]]])}
    if isinstance(description, ArmDescription):
        robot = SimulatedArm(1, with_object=False, robot_model=description)
        start = {"joint_position": np.array([description.home])}
    else:
        robot = SimulatedBase(robot_model=description, boxes=2)
    robot.connect()
    try:
        robot.reset(np.arange(1), Initial(start, np.zeros(1, np.int64)))
        image = io.BytesIO()
        Image.fromarray(robot.render("rgb_array", [])).save(image, format=_PICTURES[path.suffix.lower()])
        Place(path).write(image.getvalue())
    finally:
        robot.close()


def write_profile(config: ProfileConfig) -> None:
    """Write the profile of a robot from its live graph or a contract of rosetta, or the contract of its profile."""
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot_models import Description, find_model
    from bam_envs.robots.base_description import base_model
    from bam_envs.robots.profile import described_spec, profile_for, read_profile
    from bam_train.cli.arms.base_graph import BaseGraphProfile
    from bam_train.cli.arms.live_graph import GraphProfile, profile_toml
    from bam_train.cli.arms.rosetta_contract import contract_text

    robot = find_model(config.name, Description)
    path = config.out or Path("robots") / "profiles" / f"{robot.name}.toml"
    for flag, file in (("--rosetta", config.rosetta), ("--out", None if config.url is None else path)):
        if file is not None and file.exists() and not config.force:
            raise InvalidValue(f"{file} exists; give another name with {flag}, or --force to replace it.")
    if config.url is not None:
        graph = _graph(config, config.url, robot.name)
        if not config.force:
            _require_named(robot, graph)
        found: GraphProfile | BaseGraphProfile
        if isinstance(robot, ArmDescription):
            found = GraphProfile(robot, graph)
        else:
            found = BaseGraphProfile(base_model(robot), graph)
        profile = read_profile(profile_toml(found), str(path))
        if isinstance(robot, ArmDescription):
            found.notes += _against_urdf(robot, graph, profile, forced=config.force)
        Place(path).write(profile_toml(found).encode())
        tell(f"wrote {path}:", *(f"  {line}" for line in _profile_lines(profile)))
        if found.notes:
            tell("notes, written at its head:", *(f"  {note}" for note in found.notes))
    elif config.rosetta is None:
        raise InvalidValue("Where is the robot? Give its address or a contract with --from, or --rosetta FILE.")
    else:
        profile = profile_for(described_spec(robot))
    if config.rosetta is not None:
        Place(config.rosetta).write(contract_text(profile).encode())
        tell(f"wrote {config.rosetta}: a contract of rosetta")


def _graph(config: ProfileConfig, source: str, name: str) -> LiveGraph:
    """The graph at an address, or of a contract of rosetta."""
    from bam_envs.core.location import LiveRobot
    from bam_envs.rosbridge.client import RosbridgeLink
    from bam_envs.rosbridge.endpoint import Endpoint
    from bam_train.cli.arms.live_graph import read_graph
    from bam_train.cli.arms.rosetta_contract import contract_graph

    if Path(source).suffix in (".yaml", ".yml"):
        return contract_graph(Path(source).expanduser(), name)
    link = RosbridgeLink(Endpoint.of(LiveRobot(source, config.credentials)), name="profile")
    try:
        link.connect()
        return read_graph(link)
    finally:
        link.close()


def _require_named(robot: Description, graph: LiveGraph) -> None:
    """`InvalidValue` if the robot of `graph` calls itself by the name of another one than `robot`."""
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot_models import DEFAULT_ARM
    from bam_envs.robots.profile import load_profile, shipped_profiles

    told = load_profile(graph.name).robot if graph.name in shipped_profiles() else graph.name
    same = told == DEFAULT_ARM and isinstance(robot, ArmDescription) and robot.geometry  # UR arms share a profile
    if told and told != robot.name and not same:
        raise InvalidValue(
            f"{graph.url}: the robot there calls itself {told}, and {robot.name} was named. Give bam-robots profile "
            f"{told} --from {graph.url}, or --force if it is {robot.name}."
        )


def _against_urdf(arm: ArmDescription, graph: LiveGraph, profile: RobotProfile, *, forced: bool) -> Iterator[str]:
    """What differs between an arm and the URDF of `graph`; `InvalidValue` if that is another arm, unless `forced`."""
    from bam_envs.live.arm_checks import described_checks
    from bam_envs.live.building import profile_limits
    from bam_envs.live.examination import DESCRIPTION, Inspection

    seen = Inspection(profile, None, (), (), None, {DESCRIPTION: graph.urdf}, 0.0)
    margin = profile_limits(profile).position_margin
    for line in described_checks(arm.spec(with_object=False), arm.chain, margin, seen):
        if line.fits is False and line.what.startswith("kinematics") and not forced:
            raise InvalidValue(
                f"{graph.url}: {line.what}: {line.found}, {arm.name}. Name the arm that is there, or give --force."
            )
        if line.fits is False:
            yield f"{line.what}: expected {line.expected}, found {line.found}"


def _profile_lines(profile: RobotProfile) -> Iterator[str]:
    yield f"states: {', '.join(dict.fromkeys(source.topic for source in profile.state if not source.optional))}"
    for mode, sinks in profile.commands.items():
        yield f"{mode}: {', '.join(sink.address for sink in sinks)}"
    if profile.enable:
        yield f"enabled by: {', '.join(one.service for one in profile.enable)}"


def list_models(config: ListArmsConfig) -> int | None:
    """List the robots."""
    from bam_envs.core.robot_models import known_models
    from bam_train.files.log_lines import aligned

    rows = [_row(name, path) for name, path in sorted(known_models().items())]
    tell(*aligned([["name", "kind", "what", "file"], *rows]), "")
    tell("Another arm: bam-robots add NAME --urdf FILE --gripper parallel:0.08")
    return 1 if any(kind == "-" for _, kind, *_ in rows) else 0


def _row(name: str, path: Any) -> list[str]:
    """One robot of the list; a file that cannot be read does not hide the others."""
    from bam_envs.arms.description import ArmDescription
    from bam_envs.core.robot_models import read_description

    try:
        robot = read_description(path)
    except InvalidValue as error:
        return [name, "-", f"cannot be read: {error}", str(path)]
    kind = f"{robot.num_joints} joints" if isinstance(robot, ArmDescription) else "base"
    return [name, kind, robot.title, str(path)]
