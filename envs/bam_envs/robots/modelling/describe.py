"""Make the description of an arm from its model files, and write it with what had to be assumed."""

import dataclasses
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import numpy as np

from bam_envs.arms.capsules import WHOLE, Outline, fitted_capsules
from bam_envs.arms.description import ArmDescription, Gripper, JointRow, Placed, Vector
from bam_envs.arms.serial_chain import Capsule, SerialChain
from bam_envs.arms.work_area import find_work_area
from bam_envs.core.errors import InvalidValue
from bam_envs.core.validation import NewtonMetres, RadPerS, check_fields, fits
from bam_envs.robots.modelling.model_files import Array, ReadArm, Shapes, read_arm

SPEED, ACCELERATION, JERK = 1.5, 6.0, 120.0
"""Limits of a joint where the files name none [rad/s, rad/s^2, rad/s^3]: below those of every arm that is shipped."""
EFFORT_PER_REACH = 60.0
"""Torque of a joint where the files name none [N m], for each metre from the joint to the tool."""
_POSTURES = 10_000
"""Postures in which the outline is compared with the links."""
_GIVEN_UP = 0.1
_WAYS = ((0, 1, 0), (2, 0, 0), (0, 0, 1), (2, 1, 0))  # what a link gets: more capsules, thinner ones, another search
_REFITS, _FALSE = 40, 0.0125  # times that links get other capsules, and the share of false alarms that is good enough
DEEP = 0.005
"""A collision deeper than this is to be found [m]."""
_CLEARANCE = 0.005  # that the guards keep, so that they act where links touch [m]
_TOUCH = 0.0045  # depth from which shapes touch, and what is kept of the slack [m]
_SURE = 0.001
_RARE = 0.003  # share of postures in which two links count as touching falsely, that needs no slack
_MANY = 150  # postures in which two links touch, that show how far apart their capsules can be; else slack is less
_ROUNDS, _WORST, _AROUND, _STRAY = 4, 20, 10, 0.1  # of a search: postures kept in each, others about each, within [rad]
_ANYWHERE = 5.6  # travel of a first joint with which an arm works in any direction [rad]
_ASIDE = 0.02  # of the middle of all postures from the base, that tells the direction of an arm [m]
Form = tuple[int, int, int]
"""How the capsules of a link are fitted: their number, the power of their radius, and the seed of the search."""
Apart = Mapping[tuple[int, int], Array]
"""Distances of two links in many postures [m]; see `Shapes.distances`."""
_FARTHEST = 3.0  # an arm longer than this has its lengths in another unit [m]


def describe(
    name: str, model: str, gripper: str | None, site: str | None, *, tell: Callable[[str], None] = lambda _: None
) -> tuple[ArmDescription, list[str]]:
    """The description of the arm in the file `model` with `gripper`, and one note for each thing that is assumed.

    Args:
        name: Its name.
        model: An MJCF or URDF file, or ``menagerie:NAME``.
        gripper: As `model`, or ``parallel:WIDTH`` [m]; None if the joints behind `site` are the gripper.
        site: Site or body at the end of the arm; None for the first of the usual names that is there.
        tell: Takes a line before each part that takes some seconds.

    Raises:
        InvalidValue: The files hold no arm that could work; one line that says why.
    """
    read = read_arm(model, gripper, site)
    reach = float(np.linalg.norm(read.placements[:, :3, 3], axis=1).sum())
    if not 0.15 < reach < _FARTHEST:
        raise InvalidValue(f"{model}: the arm is {reach:.3g} m long; are its lengths in metres?")
    size = max(float(np.abs(points).max(initial=0.0)) for points in read.points)
    if size > _FARTHEST:
        raise InvalidValue(f"{model}: a shape reaches {size:.3g} m from its joint; are its lengths in metres?")
    joints = joint_rows(read)
    for row in joints:
        check_fields(row, lambda key, row=row: f"{model}: {row.name}: {key}")  # type: ignore[misc]
    tool = _placed(read.tool)
    width = read.width
    first = ArmDescription(
        name=name,
        title=f"{name}, from {Path(model).name}",
        joints=joints,
        home=tuple(0.5 * (row.low + row.high) for row in joints),
        tool=tool,
        gripper=Gripper(open=width, mass=round(read.gripper_mass, 3)),
        workspace=((0.3, -0.25, 0.016), (0.7, 0.25, 0.35)),
        capsules=(),
        sources={"model": model, **({"gripper": gripper} if gripper else {})},
    )
    if read.shapes is not None:
        tell(f"comparing capsules with the shapes of the links, in {_POSTURES} postures")
    arm, how_well = _outlined(first, read)
    try:
        found = _with_area(arm, read.notes, tell)
    except InvalidValue:
        if read.shapes is None:
            raise
        # Capsules are thicker than a bent link: what the slightest of its collisions are is given up.
        read.shapes.trust_pads()
        arm, how_well = _outlined(first, read, _GIVEN_UP)
        found = _with_area(arm, read.notes, tell)
        read.notes.append(
            f"collisions of the arm with itself: the slightest {_GIVEN_UP:.0%} of two links are not noticed"
        )
    if how_well:
        seen, every = (int(word) for word in how_well.split()[:3:2])
        if seen < WHOLE * every:
            read.notes.append(f"{every - seen} of {every} collisions of the arm with itself are not seen by the guards")
        found = dataclasses.replace(found, sources={**found.sources, "outline": how_well})
    return found, read.notes


def _with_area(arm: ArmDescription, notes: list[str], tell: Callable[[str], None]) -> ArmDescription:
    """The arm with its work area, its base turned to face x if it works in few directions, or in none as it stands."""
    facing = _facing(arm.chain)
    if arm.chain.high[0] - arm.chain.low[0] > _ANYWHERE:
        try:
            return find_work_area(arm, _turned(arm), tell=tell)
        except InvalidValue:
            if not facing:
                raise
    turn = np.pi / 4 * facing
    placed = dataclasses.replace(arm, mount=Placed(quat=(float(np.cos(turn)), 0.0, 0.0, float(np.sin(turn)))))
    found = find_work_area(placed, _turned(placed), tell=tell)
    if facing:
        notes.append(
            f"the base is turned by {90 * facing} degrees about z, to face x (mount), as poses of a live robot are"
        )
    return found


def _facing(chain: SerialChain) -> int:
    """Quarter turns about z of the base after which the arm is before x with its first joint in mid-travel."""
    low, high = np.maximum(chain.low, -np.pi), np.minimum(chain.high, np.pi)
    q = low + np.random.default_rng(0).random((1000, chain.num_joints)) * (high - low)
    q[:, 0] = 0.5 * (chain.low[0] + chain.high[0])
    x, y, _ = (chain.tool_position(q) - chain.placements[0, :3, 3]).mean(axis=0)
    return round(-float(np.arctan2(y, x)) / (np.pi / 2)) if np.hypot(x, y) > _ASIDE else 0


def _turned(arm: ArmDescription) -> ArmDescription:
    """The arm with the axes of its tool turned by half a turn, which two pads do not tell apart."""
    half = np.diag([-1.0, -1.0, 1.0, 1.0])

    def across(point: Vector) -> Vector:
        return -point[0], -point[1], point[2]

    capsules = tuple(
        dataclasses.replace(one, start=across(one.start), end=across(one.end)) if one.link > arm.num_joints else one
        for one in arm.capsules
    )
    return dataclasses.replace(arm, tool=_placed(arm.tool.matrix() @ half), capsules=capsules)


def _outlined(arm: ArmDescription, read: ReadArm, given_up: float = 0.0) -> tuple[ArmDescription, str]:
    """The arm with capsules around its links, and how well they find its collisions with itself.

    Two links whose capsules touch too often while the links are apart get thinner ones, more of them, or others.

    Args:
        arm: The description without capsules.
        read: The points and the shapes of its links.
        given_up: The share of the slightest collisions of two links that need not be found.
    """
    groups = [*enumerate(read.points), *((arm.num_joints + 1, points) for points in read.grip)]
    usual = (2, 2, 0)  # number of capsules, power of their radius, seed of the search
    fits = [{usual: fitted_capsules(points, link)} for link, points in groups]

    def fitted(forms: Mapping[int, Form]) -> ArmDescription:
        capsules: list[Capsule] = []
        for known, (link, points) in zip(fits, groups, strict=True):
            if (form := forms.get(link, usual)) not in known:
                known[form] = fitted_capsules(points, link, *form)
            capsules += known[form]
        return dataclasses.replace(arm, capsules=tuple(capsules), slack=())

    best, forms, kept = fitted({}), dict[int, Form](), dict[int, Form]()
    q = postures(arm.chain)
    apart = {} if read.shapes is None else read.shapes.distances(q)
    if not apart:
        return best, ""
    share, missed, worst, spent = 1.0, len(q), list[tuple[int, int]](), set[tuple[int, Form]]()
    tried = set[tuple[Capsule, ...]]()
    while len(tried) < _REFITS:
        trial = fitted(forms)
        if trial.capsules not in tried:
            tried.add(trial.capsules)
            trial = dataclasses.replace(trial, slack=tuple(_slack(trial, q, apart, given_up)))
            wrong, overlooked, blamed = judged(trial, q, apart)
            if (overlooked, wrong) < (missed, share):
                best, share, missed, kept, worst, spent = trial, wrong, overlooked, forms, blamed, set()
        ways = ((link, more) for pair in worst for more in _WAYS for link in pair)
        way = next((way for way in ways if way not in spent), None)
        if share <= _FALSE or way is None:
            break
        spent.add(way)
        (link, (count, power, seed)), before = way, kept.get(way[0], usual)
        forms = {**kept, link: (before[0] + count, before[1] + power, before[2] + seed)}
    if not given_up and read.shapes is not None:
        best = dataclasses.replace(best, slack=tuple(_sure_slack(best, q, apart, read.shapes)))
        share, missed, _ = judged(best, q, apart)
    deep = sum(np.min([*apart.values()], axis=0) < -DEEP)
    found = f"{deep - missed} of {deep} collisions of the arm with itself in {len(q)} postures are found"
    return best, f"{found}, and {share:.1%} of the other postures count as one"


def judged(arm: ArmDescription, q: Array, apart: Apart) -> tuple[float, int, list[tuple[int, int]]]:
    """How the capsules of an arm compare with its links at the joints `q` (n, k) [rad].

    Args:
        arm: The arm.
        q: Joint positions.
        apart: Distances of its links there; see `Shapes.distances`.

    Returns:
        The share of the postures without a collision in which the guards would act, the number of collisions deeper
        than `DEEP` in which they would not, and the links that are falsely near, most often first.
    """
    outline = Outline(arm.chain)
    known = np.array([tuple(pair) in apart for pair in outline.links[outline.pairs].tolist()], dtype=bool)
    gaps, links = outline.distances(q)[:, known], outline.links[outline.pairs[known]]
    if not known.any():
        gaps = np.full((len(q), 1), np.inf)
    acts, nearest = (gaps < _CLEARANCE).any(axis=1), np.min([*apart.values()], axis=0)
    free = nearest > _CLEARANCE
    blamed = Counter((int(i), int(j)) for i, j in links[gaps[acts & free].argmin(axis=1)])
    share = float((acts & free).sum() / max(1, free.sum()))
    return share, int((~acts & (nearest < -DEEP)).sum()), [pair for pair, _ in blamed.most_common()]


def _slack(arm: ArmDescription, q: Array, apart: Apart, given_up: float) -> Iterator[tuple[int, int, float]]:
    """For two links, how far their capsules overlap while their shapes are apart [m], if it matters.

    Args:
        arm: The arm, without slack.
        q: Joint positions [rad]. Shape: (n, k).
        apart: Distances of its links there; see `Shapes.distances`.
        given_up: The share of the slightest collisions that does not count.
    """
    outline, usual = Outline(arm.chain, every=True), Outline(arm.chain)
    guarded = {(int(i), int(j)) for i, j in usual.links[usual.pairs]}
    gaps, links = outline.distances(q), outline.links[outline.pairs]
    for one, other in sorted({(int(i), int(j)) for i, j in links} & apart.keys()):
        gap = gaps[:, (links == [one, other]).all(axis=1)].min(axis=1)
        acts, known = gap < _CLEARANCE, (one, other) in guarded
        touches = int((apart[one, other] < -_TOUCH).sum())
        if not touches and not known:
            continue  # limits of joints keep these links apart
        few = touches < _MANY
        touching = np.sort(gap[acts & (apart[one, other] < (0.0 if few else -_TOUCH))])[::-1]  # the slightest first
        slack = 0.0
        if (acts & (apart[one, other] > _CLEARANCE)).mean() > _RARE * (1 + few):
            least = touching[int(given_up * len(touching))] if len(touching) else gap.min()
            slack = max(0.0, _CLEARANCE - float(least) - _SURE)
        if slack > 0.002 or not known:
            yield one, other, round(slack, 3)


def _sure_slack(arm: ArmDescription, q: Array, apart: Apart, shapes: Shapes) -> Iterator[tuple[int, int, float]]:
    """The slack of an arm, less where two links collide in postures about those in which it is the least sufficient."""
    outline, rng, chain = Outline(arm.chain), np.random.default_rng(0), arm.chain
    links = outline.links[outline.pairs]
    for one, other, slack in arm.slack:
        mine, known = (links == [one, other]).all(axis=1), q[apart[one, other] < -DEEP]
        if mine.any() and len(known):
            gap = outline.distances(known)[:, mine].min(axis=1)
            for _ in range(_ROUNDS):
                near = np.repeat(known[np.argsort(-gap)[:_WORST]], _AROUND, axis=0)
                near = np.clip(near + _STRAY * rng.standard_normal(near.shape), chain.low, chain.high)
                near = near[shapes.distances(near, [(one, other)])[one, other] < -DEEP]
                known = np.concatenate([known, near])
                gap = np.concatenate([gap, outline.distances(near)[:, mine].min(axis=1)])
            slack = round(min(slack, max(0.0, slack + _CLEARANCE - float(gap.max()) - _SURE)), 4)
        yield one, other, slack


def postures(chain: SerialChain, seed: int = 0) -> Array:
    """Random postures of an arm, each joint within a turn (n, k) [rad]."""
    low, high = np.maximum(chain.low, -np.pi), np.minimum(chain.high, np.pi)
    q: Array = low + np.random.default_rng(seed).random((_POSTURES, len(low))) * (high - low)
    return q


def joint_rows(read: ReadArm) -> tuple[JointRow, ...]:
    """The joints, with defaults for the limits that the files do not name, each with a note."""
    rows, size, slow = [], len(read.names), dict[str, list[str]]()
    lengths = np.linalg.norm(read.placements[:, :3, 3], axis=1)
    for at, name in enumerate(read.names):
        placed = _placed(read.placements[at])
        beyond = float(lengths[at + 1 :].sum() + np.linalg.norm(read.tool[:3, 3]))
        effort, velocity = read.effort[at], read.velocity[at]
        if effort is None or not fits(effort, NewtonMetres):
            why, effort = _why("torque", effort, "N m"), round(EFFORT_PER_REACH * max(beyond, 0.1), 1)
            read.notes.append(f"{name}: {why}, so {effort:g} N m")
        if velocity is None or not fits(velocity, RadPerS):
            slow.setdefault(_why("speed", velocity, "rad/s"), []).append(name)
            velocity = SPEED
        axis = tuple(round(float(one), 9) + 0.0 for one in read.axes[at])
        rows.append(
            JointRow(
                name=name,
                xyz=placed.xyz,
                quat=placed.quat,
                axis=axis,  # type: ignore[arg-type]
                low=round(read.low[at], 5),
                high=round(read.high[at], 5),
                velocity=velocity,
                acceleration=ACCELERATION,
                jerk=JERK,
                effort=effort,
                mass=round(read.mass[at], 3),
            )
        )
    for why, names in slow.items():
        which = f"all {size} joints" if len(names) == size else ", ".join(names)
        read.notes.append(f"{which}: {why}, so {SPEED:g} rad/s")
    read.notes.append(
        f"all {size} joints: no acceleration or jerk in the files, so {ACCELERATION:g} rad/s^2, {JERK:g} rad/s^3"
    )
    return tuple(rows)


def _why(what: str, found: float | None, unit: str) -> str:
    """Why a limit in the files does not count."""
    return f"no {what} in the files" if found is None else f"the {what} of {found:g} {unit} in the files is no limit"


def _placed(matrix: Array) -> Placed:
    """A homogeneous matrix as a pose, its quaternion to 12 digits."""
    m = matrix[:3, :3]
    square = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    x, y, z, w = np.linalg.eigh(square / 3)[1][:, -1]
    quat = np.array([w, x, y, z]) * (1.0 if w >= 0 else -1.0)
    return Placed(xyz=_plain(matrix[:3, 3]), quat=_plain(quat))  # type: ignore[arg-type]


def _plain(values: Array) -> tuple[float, ...]:
    return tuple(round(float(one), 12) + 0.0 for one in values)


def as_toml(description: ArmDescription, notes: list[str]) -> str:
    """The text of a description's file."""
    table = dataclasses.asdict(description)
    lines = [f"# {note}" for note in notes] + [""] * bool(notes)
    for key in ("name", "title", "geometry"):
        lines += [f"{key} = {_toml(table[key])}"] if table[key] else []
    lines += [
        f"home = {_toml(table['home'])}",
        f"slack = {_toml(table['slack'])}",
        f"workspace = {_toml(table['workspace'])}",
    ]
    lines += [
        f"tool = {_toml(table['tool'])}",
        f"mount = {_toml(table['mount'])}",
        f"gripper = {_toml(table['gripper'])}",
    ]
    for key in ("joints", "capsules"):
        lines += [f"{key} = [", *(f"  {_toml(row)}," for row in table[key]), "]"]
    lines += ["", "[sources]", *(f"{name} = {_toml(value)}" for name, value in description.sources.items())]
    return "\n".join(lines) + "\n"


def _toml(value: object) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, dict):
        kept = {
            key: one for key, one in value.items() if one not in ((0.0,) * 3, (1.0, 0.0, 0.0, 0.0)) or key == "axis"
        }
        return "{ " + ", ".join(f"{key} = {_toml(one)}" for key, one in kept.items()) + " }"
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)
