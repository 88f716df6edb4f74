"""Read an arm and its gripper from MJCF or URDF files, with MuJoCo's `MjSpec`: joints, limits, tool, shapes.

What a file does not say gets a default, and a note that says so.
"""

import contextlib
import importlib
import itertools
import math
import re
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bam_envs.core.errors import InvalidValue, MissingExtra, UnknownName
from bam_envs.core.validation import NewtonMetres, RadPerS, fits
from bam_envs.core.wording import closest, did_you_mean
from bam_envs.robots.modelling.mesh_parts import model_in_parts
from bam_envs.robots.physics.mujoco_batch import mujoco

Array = NDArray[np.float64]
SITES = ("attachment_site", "right_hand", "tool0", "flange", "ee_link", "link_tcp", "tcp", "gripper_frame_link")
"""Names of sites and bodies that are taken as the end of an arm if none is given."""
_FEWEST_JOINTS, _MOST_JOINTS = 4, 8
_MESHES = (".stl", ".obj", ".msh")
_PAD, _BOX = "bam_pad", mujoco.mjtGeom.mjGEOM_BOX
_PARALLEL, _ACROSS = 0.99, 0.3  # cosine of the angle of axes that count as one, and of those across
_FLUSH = 0.02  # shapes of the end that stand out less do not move the gripper [m]
_END = "_end"  # ends the name of the body at the end of an arm
CONTINUOUS = 2 * np.pi
"""Limit of a joint that turns without end [rad]."""
WIDEST = 0.10
"""Widest gripper that is simulated [m]."""
_FETCH = "fetch the mesh again; a repository with Git LFS holds a pointer in its place"
_REMEDIES = {
    "repeated name": "give each of them a name of its own",
    "unrecognized": "the file is for another version of MuJoCo: take it out",
    "no decoder": "MuJoCo reads STL, OBJ and MSH: convert the mesh, or give the link a shape",
    "bad format": "write a number there",
    "is empty": _FETCH,
    "invalid header": _FETCH,
    "Error opening": "put that file where it is looked for, beside this one",
    "Unrecognized XML model type": "give an MJCF or URDF file; a part of one is read through the file that includes it",
}
"""What to do about a file that MuJoCo refuses, by words in its text."""
_DIVERGED = tuple(int(getattr(mujoco.mjtWarning, f"mjWARN_BADQ{one}")) for one in ("POS", "VEL", "ACC"))
_SETTLING = 2.0  # time for a linkage to come to rest [s]
_ABOVE = 4  # folders above a xacro file beside which its packages are looked for
_JAW = re.compile("jaw|grip|finger|claw", re.IGNORECASE)
_FINGERTIP = 0.03  # depth of a finger's tip along the gripper [m]


@dataclass
class ReadArm:
    """An arm as its files say it."""

    names: list[str]
    placements: Array
    axes: Array
    tool: Array
    low: list[float]
    high: list[float]
    velocity: list[float | None]
    effort: list[float | None]
    """None where the files have no limit; one that is greater than a joint's can be is a placeholder."""
    mass: list[float]
    points: list[Array]
    """Points of each link in its frame [m]: base, then what each joint turns."""
    grip: list[Array] = field(default_factory=list)
    """Points of the gripper's body and of its open fingers in the tool's frame [m]."""
    shapes: "Shapes | None" = None
    width: float = 0.0
    gripper_mass: float = 0.0
    notes: list[str] = field(default_factory=list)


def read_arm(model: str, gripper: str | None, site: str | None) -> ReadArm:
    """The arm in the file `model`, with `gripper`: a file, ``parallel:WIDTH``, or None for the joints behind the site.

    Raises:
        InvalidValue: A file is not there, MuJoCo refuses it, or the arm in it cannot work; one line that says why.
    """
    parallel = _parallel(gripper)
    with tempfile.TemporaryDirectory() as folder:  # of meshes that MuJoCo does not read itself
        spec, limits = _spec(model, folder)
        arm, notes = _named_body(spec, site, model, gripper)
        if gripper is not None and parallel is None:
            _attach(spec, arm, gripper, folder)
        return _Reader(spec, arm.name, parallel, model, limits, notes).read()


def _pads(width: float) -> list[tuple[Array, Array]]:
    """Opposite corners of palm and open pads in the frame of the arm's end, which close along its x axis [m]."""
    length, half = _length(width), 0.5 * width
    palm = np.array([-0.03, -0.03, 0.0]), np.array([0.03, 0.03, length - 0.06])
    return [palm, (np.array([-half - 0.012, -0.011, length - 0.06]), np.array([half + 0.012, 0.011, length + 0.014]))]


def _length(width: float) -> float:
    """From the end of the arm to the middle of the pads [m]."""
    return 0.10 + 0.5 * width


def _parallel(gripper: str | None) -> float | None:
    """The width [m] of ``parallel:0.08``."""
    if gripper is None or not gripper.startswith("parallel:"):
        _require_scheme(gripper or "", "parallel:WIDTH")
        return None
    with contextlib.suppress(ValueError):
        if 0.005 <= (width := float(gripper.partition(":")[2])) <= 0.3:
            return width
    raise InvalidValue(f"--gripper {gripper}: give the width of the open gripper in metres, from 0.005 to 0.3.")


def _require_scheme(name: str, *more: str) -> None:
    """Refuse a name with a misspelt word before its colon; `more` are forms that it may have beside menagerie:NAME."""
    word, colon, rest = name.partition(":")
    known = {form.partition(":")[0]: form for form in ("menagerie:NAME", *more)}
    if colon and word not in known and not Path(name).exists() and (meant := closest(word, known)):
        raise InvalidValue(
            f"{name}: there is no {word}:, only {' and '.join(known.values())}. Did you mean {meant}:{rest}?"
        )


def _spec(name: str, folder: str) -> tuple[Any, dict[str, tuple[float | None, float | None]]]:
    """The model in a file as MuJoCo reads it, and the velocities and efforts in an URDF, by joint."""
    if name.startswith("menagerie:"):
        return _menagerie(name.partition(":")[2]), {}
    _require_scheme(name)
    path = Path(name)
    if not path.is_file():
        raise InvalidValue(f"There is no model file {name}. Give an MJCF or URDF file, or menagerie:NAME.")
    limits: dict[str, tuple[float | None, float | None]] = {}
    try:
        if is_urdf(path):
            text, limits = _urdf(path, folder)
            spec = mujoco.MjSpec.from_string(text)
        else:
            spec = mujoco.MjSpec.from_file(str(path))
    except InvalidValue:
        raise
    except ElementTree.ParseError as error:
        raise InvalidValue(f"{name} is not XML: {_line(error)}. Is the file whole?") from error
    except (ValueError, OSError) as error:
        raise _refusal(f"MuJoCo cannot read {name}", error) from error
    return spec, limits


def is_urdf(path: Path) -> bool:
    """Whether a model file is a URDF or xacro file, by its first element, or by its name if it has none."""
    root = re.search(rb"<(robot|mujoco)\b", path.read_bytes()[:4000]) if path.is_file() else None
    return path.suffix == ".xacro" or (path.suffix == ".urdf" if root is None else root[1] == b"robot")


def _menagerie(name: str) -> Any:
    try:
        menagerie: Any = importlib.import_module("mujoco_menagerie")
    except ImportError as error:
        raise MissingExtra("mujoco_menagerie", "robots", f"menagerie:{name}") from error
    try:
        return menagerie.get(name).spec()
    except Exception as error:  # its errors, and those of the network, are many
        if "Unknown robot" in str(error):
            known = menagerie.names()
            meant = min([one for one in known if name in one], key=len, default=name)
            listing = f"mujoco-menagerie names lists all {len(known)}."
            examples = get_close_matches(name, known, cutoff=0.0)
            raise UnknownName("robot of menagerie", name, known, examples, meant=meant, remedy=listing) from error
        raise InvalidValue(
            f"menagerie:{name} cannot be fetched: {_line(error)}. Set the variable MENAGERIE_ROOT to a folder with the "
            "models, or try again with a network."
        ) from error


def _refusal(what: str, error: BaseException) -> InvalidValue:
    """An error in the words of MuJoCo, with what to do about it."""
    text = _line(error)
    remedy = next((one for words, one in _REMEDIES.items() if words in text), "correct the file, or give another")
    return InvalidValue(f"{what}: {text}. Remedy: {remedy}.")


def _line(error: BaseException) -> str:
    text = re.sub(r"<class '[\w.]+'>: |XML Error: |Error: ", "", " ".join(str(error).split()))
    return text.rstrip(".")


def _urdf(path: Path, folder: str) -> tuple[str, dict[str, tuple[float | None, float | None]]]:
    """The text of an URDF with the files of its meshes found, and velocity and effort of its joints."""
    root = _parsed(_expanded(path) if path.suffix == ".xacro" else path.read_text(encoding="utf-8"))
    if path.suffix != ".xacro" and any("xacro}" in one.tag for one in root.iter()):
        root = _parsed(_expanded(path))
    _check_names(path, root)
    for link in root.iter("link"):
        drawn = link.findall("visual")
        for visual in drawn:
            if link.find("collision") is None or link.find("collision") in drawn:
                visual.tag = "collision"  # a link is what is drawn of it, where nothing else is said
            else:
                link.remove(visual)
    for mesh in root.iter("mesh"):
        mesh.set("filename", _readable(_mesh_file(path, mesh.get("filename", "")), folder))
    for old in root.findall("mujoco"):
        root.remove(old)
    options = {"strippath": "false", "discardvisual": "true", "fusestatic": "false", "balanceinertia": "true"}
    options |= {"boundmass": "0.001", "boundinertia": "0.000001"}
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", options)
    limits = {}
    for joint in root.findall("joint"):
        limit, name = joint.find("limit"), joint.get("name", "")
        if joint.get("type") == "revolute" and (limit is None or not {"lower", "upper"} & {*limit.keys()}):
            remedy = "give it lower and upper [rad], or the type continuous if it turns without end"
            raise InvalidValue(f"{path}: {name} is revolute and has no position limits: {remedy}.")
        if limit is not None:
            low, high, *given = (_number(path, name, limit, key) for key in ("lower", "upper", "velocity", "effort"))
            if low > high:
                raise InvalidValue(f"{path}: {name}: its lower limit {low:g} is above its upper limit {high:g}.")
            limits[name] = _believable(given[:1], RadPerS), _believable(given[1:], NewtonMetres)
    return ElementTree.tostring(root, encoding="unicode"), limits


def _believable(limits: Sequence[float | None], kind: Any) -> float | None:
    """The first of `limits` of a joint that is a `kind`, else the first that is too great for one, else None."""
    given = [one for one in limits if one is not None and 0.0 < one < np.inf]
    return next((one for one in given if fits(one, kind)), next(iter(given), None))


def _parsed(text: str) -> ElementTree.Element:
    """The XML in `text`; prefixes that are not declared, such as ``drake:``, are part of a name, as in ROS."""
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        if "unbound prefix" not in str(error):
            raise
    known = {"xmlns", *re.findall(r"xmlns:(\w+)", text)}
    return ElementTree.fromstring(
        re.sub(r"(?<=[\s</])(\w+):(?=\w)", lambda found: found[0] if found[1] in known else f"{found[1]}_", text)
    )


def _check_names(path: Path, root: ElementTree.Element) -> None:
    """Refuse names that come twice or are not there, and closed loops, none of which MuJoCo tells."""
    names = {kind: [one.get("name", "") for one in root.findall(kind)] for kind in ("link", "joint")}
    for kind, found in names.items():
        if twice := [name for name in found if found.count(name) > 1 or not name]:
            raise InvalidValue(f"{path}: two {kind}s are called {twice[0]!r}: give each of them a name of its own.")
    for joint in root.findall("joint"):
        for part, key, kind in (("parent", "link", "link"), ("child", "link", "link"), ("mimic", "joint", "joint")):
            name = joint.find(part).get(key, "") if joint.find(part) is not None else None  # type: ignore[union-attr]
            if name is not None and name not in names[kind]:
                hint = did_you_mean(name, names[kind])
                raise InvalidValue(f"{path}: {joint.get('name')}: its {part} {name!r} is no {kind} of the file. {hint}")
    held: dict[str, str | None] = {}
    for joint in root.findall("joint"):
        link, name = joint.find("child").get("link", ""), joint.get("name")  # type: ignore[union-attr]
        if (other := held.setdefault(link, name)) != name:
            loop = "a closed loop, and only trees of links are read: take one of the two out"
            raise InvalidValue(f"{path}: the link {link!r} hangs on the joints {other} and {name}: {loop}.")


def _number(path: Path, joint: str, limit: ElementTree.Element, key: str) -> float:
    try:
        return float(limit.get(key, 0.0))
    except ValueError as error:
        raise InvalidValue(f"{path}: {joint}: {key} must be a number, not {limit.get(key)!r}.") from error


def _expanded(path: Path) -> str:
    """The URDF of a xacro file."""
    try:
        xacrodoc: Any = importlib.import_module("xacrodoc")
    except ImportError as error:
        raise MissingExtra("xacrodoc", "robots", f"The xacro file {path}") from error
    for above in list(path.resolve().parents[:_ABOVE])[::-1]:  # the nearest last, which is the one that counts
        folders = {folder.name: folder for folder in above.parent.iterdir() if folder.is_dir()}
        xacrodoc.packages.update_package_cache(folders)
    try:
        return str(xacrodoc.XacroDoc.from_file(str(path)).to_urdf_string())
    except Exception as error:  # of its parser, of packages that are not found
        text = _line(error)
        if lacking := re.search(r"ackage not found: (\S+)", text):
            raise InvalidValue(
                f"{path} cannot be expanded: its package {lacking[1]} is not beside the folder of the file. Put it "
                "there, source its workspace first, or give the URDF."
            ) from error
        raise InvalidValue(f"{path} cannot be expanded: {text}.") from error


def _readable(file: str, folder: str) -> str:
    """The file of a mesh, converted into `folder` if MuJoCo does not read its kind, such as COLLADA."""
    path = Path(file)
    if path.suffix.lower() in _MESHES:
        return file
    try:
        trimesh: Any = importlib.import_module("trimesh")
    except ImportError as error:
        raise MissingExtra("trimesh", "robots", f"The mesh {file}") from error
    try:
        mesh = trimesh.load_scene(file).to_mesh()
        if mesh.units:
            mesh.convert_units("meters")
        converted = Path(folder, f"{path.stem}_{len(list(Path(folder).iterdir()))}.stl")
        mesh.export(converted)
    except Exception as error:  # of its many readers
        raise InvalidValue(f"The mesh {file} cannot be read: {_line(error)}. Give it as STL or OBJ.") from error
    return str(converted)


def _mesh_file(path: Path, name: str) -> str:
    """The file of a mesh: ``package://NAME/...`` is looked for in the folders above the URDF."""
    package, rest = re.match(r"(?:package:///?([^/]+)/|file://)?(.*)", name).groups()  # type: ignore[union-attr]
    tails = [rest] if package is None else [rest, f"{package}/{rest}"]
    for folder in path.resolve().parents:
        for tail in tails:
            if (folder / tail).is_file():
                return str(folder / tail)
    raise InvalidValue(
        f"{path}: the mesh {name} is neither beside the file nor in a folder above it. Put its package there."
    )


def _named_body(spec: Any, site: str | None, model: str, gripper: str | None) -> tuple[Any, list[str]]:
    """The body that carries the gripper: that of the site, or the body, called `site`; and what was assumed."""
    bodies = {body.name: body for body in spec.bodies if body.name}
    sites = {one.name: one for one in spec.sites if one.name}
    names = [site] if site else [name for name in SITES if name in sites or name in bodies]
    named = [one for one in (*sites, *bodies) if one != "world"]
    flag, kind = ("--tip", "link") if is_urdf(Path(model)) else ("--site", "site or body")
    if not names and (end := _last_body(spec, gripper)) is not None:
        return end, [f"the end of the arm is {end.name}, as {flag} was not given and none of the usual names is there"]
    if not named:
        raise InvalidValue(f"{model}: there is no body in it. Is it a part of another file? Then give that one.")
    if not names:
        raise InvalidValue(f"{model}: give the end of the arm with {flag}, a {kind}: {_few(named)}.")
    name = names[0]
    if name in bodies:
        return bodies[name], []
    if name not in sites:
        raise UnknownName(kind, name, named)
    return sites[name].parent.add_body(name=name + _END, pos=sites[name].pos, quat=sites[name].quat), []


def _last_body(spec: Any, gripper: str | None) -> Any:
    """The body at the end of the one chain of revolute joints, before its fingers; None if unclear.

    A last joint to which nothing but frames is fixed is its jaw if it is called so; without a `gripper` also one that
    nothing at all is fixed to, or that turns a body that is called so.
    """
    hinge, joints, body = mujoco.mjtJoint.mjJNT_HINGE, 0, spec.worldbody
    while True:
        moved = [one for one in body.bodies if one.joints or any(below.joints for below in one.find_all("body"))]
        following = moved if moved else list(body.bodies)
        if len(following) != 1 or any(joint.type != hinge for joint in following[0].joints) or joints == _MOST_JOINTS:
            break
        body = following[0]
        joints += len(body.joints)
    jaw = body
    while joints and not jaw.joints and not jaw.geoms:
        jaw = jaw.parent
    frames = jaw.find_all("body")
    named = any(_JAW.search(one.name) for one in (*jaw.joints, *([jaw] if gripper is None else [])))
    last = (gripper is None and not frames) or (named and not any(one.joints or one.geoms for one in frames))
    if joints and jaw.joints and last:
        body, joints = jaw.parent, joints - 1
    return body if joints >= _FEWEST_JOINTS and body.name else None


def _few(names: list[str]) -> str:
    return ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")


def _attach(spec: Any, body: Any, gripper: str, folder: str) -> None:
    """Put the gripper in a file on `body`."""
    other, _ = _spec(gripper, folder)
    roots = list(other.worldbody.bodies)
    if not roots:
        raise InvalidValue(f"{gripper}: there is no body in it.")
    for name in (one for one in dir(spec.option) if not one.startswith("_")):  # MuJoCo warns where they differ
        setattr(other.option, name, getattr(spec.option, name))
    try:
        body.add_frame().attach_body(roots[0], "gripper_", "")
    except ValueError as error:
        raise _refusal(f"MuJoCo cannot join {gripper}", error) from error


_FAR = 0.05
"""Distance of two links from which they count as that far apart [m]."""


class Shapes:
    """The shapes of an arm's links, as MuJoCo compares them: meshes by the convex hulls of their parts.

    Args:
        model: The compiled model.
        data: Its working memory.
        joints: The joints of the arm, in order.
        owner: The link of each body.
        pads: Geoms of a gripper of which only the width is known; nothing is compared with its link.
    """

    def __init__(self, model: Any, data: Any, joints: list[int], owner: NDArray[np.int64], pads: list[int]) -> None:
        self._model, self._data, self._where = model, data, model.jnt_qposadr[joints]
        self._geoms = [_solid(model, owner == link) for link in range(len(joints) + 2)]
        self._pads = pads

    def trust_pads(self) -> None:
        """Compare also with a gripper of which only the width is known, as its pads and palm are in simulation."""
        self._geoms[-1] += self._pads
        self._pads = []

    def distances(self, q: Array, only: list[tuple[int, int]] | None = None) -> dict[tuple[int, int], Array]:
        """For two links that can touch, their distance [m], at most 5 cm, negative if they overlap: (n, k) to (n,).

        `only` are the links to compare, all by default.

        Links that share a joint are left out, like the gripper and the last two; so are links without shapes.
        """
        geoms, last = self._geoms, len(self._where)
        links = only or [(one, other) for one in range(last - 1) for other in range(one + 2, last + 2)]
        found = {
            pair: np.full(len(q), _FAR)
            for pair in links
            if geoms[pair[0]] and geoms[pair[1]] and not (self._pads and pair[1] == last + 1)
        }
        radii, places = self._model.geom_rbound, self._data.geom_xpos
        for row, joints in enumerate(q):
            self._data.qpos[:] = 0.0
            self._data.qpos[self._where] = joints
            mujoco.mj_kinematics(self._model, self._data)
            for (one, other), apart in found.items():
                for first, second in itertools.product(geoms[one], geoms[other]):
                    if math.dist(places[first], places[second]) < radii[first] + radii[second] + _FAR:
                        near = mujoco.mj_geomDistance(self._model, self._data, first, second, _FAR, None)
                        apart[row] = min(apart[row], near)
        return found


def _is_pad(model: Any, geom: int) -> bool:
    return str(model.geom(geom).name).startswith(_PAD)


def _solid(model: Any, bodies: Any) -> list[int]:
    """The geoms of these bodies that collide; all of them if none does. Assumed pads do not count."""
    geoms = [geom for geom in range(model.ngeom) if bodies[model.geom_bodyid[geom]] and not _is_pad(model, geom)]
    solid = [geom for geom in geoms if model.geom_contype[geom] or model.geom_conaffinity[geom]]
    return solid or geoms


class _Reader:
    """Reads the compiled model of an arm that ends at the body `end`."""

    def __init__(
        self, spec: Any, end: str, parallel: float | None, where: str, limits: dict[str, Any], notes: list[str]
    ) -> None:
        self._where, self._limits, self._parallel = where, limits, parallel
        self._notes, self._spec = notes, spec
        self._compile(spec, end)
        self._out, self._begin = np.eye(3), 0.0  # axes of the gripper in the end's, and where it begins along z [m]
        if parallel is not None:
            self._out, self._begin = self._outwards()
            for at, (low, high) in enumerate(_pads(parallel)):
                pos = self._out @ (0.5 * (low + high) + [0.0, 0.0, self._begin])
                half = np.abs(self._out) @ (0.5 * (high - low))
                spec.body(end).add_geom(name=f"{_PAD}{at}", type=_BOX, pos=pos, size=half, mass=0.0)
            self._compile(spec, end)
        self._pivot: Array | None = None

    def _compile(self, spec: Any, end: str) -> None:
        try:
            self._model = spec.compile()
        except ValueError as error:
            raise _refusal(f"MuJoCo cannot build {self._where}", error) from error
        self._data = mujoco.MjData(self._model)
        self._end = self._model.body(end).id

    def _outwards(self) -> tuple[Array, float]:
        """Axes of the gripper in those of the end, and how far the shapes of the end stand out along its z [m].

        The gripper points along z of the end; if that is across the arm, along x or y about which the last joint turns.
        """
        model, data = self._model, self._data
        mujoco.mj_kinematics(model, data)
        joints, name = self._chain(), model.body(self._end).name.removesuffix(_END)
        way, axes = data.xpos[self._end] - data.xanchor[joints[-2]], data.xmat[self._end].reshape(3, 3)
        away, turns = way @ axes / max(float(np.linalg.norm(way)), 1e-9), np.abs(data.xaxis[joints[-1]] @ axes)
        axis = int(turns.argmax())
        if abs(away[2]) > _ACROSS or turns[axis] < _PARALLEL or abs(away[axis]) < 0.5:
            axis = 2
        sign = 1.0 if away[axis] > -0.5 else -1.0
        if (axis, sign) != (2, 1.0):
            self._notes.append(f"the gripper points along {'-' * (sign < 0)}{'xyz'[axis]} of {name}, away from the arm")
        out = np.eye(3)[:, [(axis + 1) % 3, (axis + 2) % 3, axis]]
        out[:, 1:] *= sign
        z = axes @ out[:, 2]
        below = np.zeros(model.nbody, bool)
        for body in range(self._end, model.nbody):
            below[body] = body == self._end or (below[model.body_parentid[body]] and not model.body_jntnum[body])
        points = self._points(below, np.eye(4)) - data.xpos[self._end]
        begin = float((points @ z).max(initial=0.0))
        if begin < _FLUSH:
            return out, 0.0
        self._notes.append(f"the gripper is fixed {begin:.3f} m from {name}, where its shapes end")
        return out, begin

    def read(self) -> ReadArm:
        model, data = self._model, self._data
        joints = self._chain()
        self._last = joints[-1]
        data.qpos[:] = 0.0
        mujoco.mj_kinematics(model, data)
        frames = []
        for joint in joints:
            frame = np.eye(4)
            frame[:3, :3] = data.xmat[model.jnt_bodyid[joint]].reshape(3, 3)
            frame[:3, 3] = data.xanchor[joint]
            frames.append(frame)
        base = np.eye(4)
        placements = [np.linalg.inv(before) @ frame for before, frame in zip([base, *frames], frames, strict=False)]
        names = [model.joint(joint).name for joint in joints]
        low, high = zip(*(self._range(joint) for joint in joints), strict=True)
        if all(high[i] - low[i] >= 4 * np.pi - 1e-9 for i in range(len(joints))) and not any(
            model.jnt_limited[joint] for joint in joints
        ):
            raise InvalidValue(f"{self._where}: its joints have no position limits: add them to the file.")
        owner = self._owners(joints)
        arm = ReadArm(
            names=names,
            placements=np.array(placements),
            axes=model.jnt_axis[joints].copy(),
            tool=np.eye(4),
            low=list(low),
            high=list(high),
            velocity=[self._limits.get(name, (None, None))[0] for name in names],
            effort=[self._effort(joint, name) for joint, name in zip(joints, names, strict=True)],
            mass=[max(0.05, float(model.body_mass[owner == link].sum())) for link in range(1, len(joints) + 1)],
            points=[self._points(owner == link, [base, *frames][link]) for link in range(len(joints) + 1)],
            notes=self._notes,
        )
        self._grip(arm, owner, frames[-1])
        solid = [geom for link in range(len(joints) + 2) for geom in _solid(model, owner == link)]
        parts = model_in_parts(self._spec, model, solid)
        pads = [geom for geom in range(parts.ngeom) if _is_pad(parts, geom)]
        arm.shapes = Shapes(parts, mujoco.MjData(parts), joints, owner, pads)
        return arm

    def _chain(self) -> list[int]:
        """The joints from the base to the end, refused if they are no serial chain of 4 to 8 revolute joints."""
        model, body, joints = self._model, self._end, []
        while body != 0:
            first, count = model.body_jntadr[body], model.body_jntnum[body]
            kinds = [int(model.jnt_type[first + i]) for i in range(count)]
            if int(mujoco.mjtJoint.mjJNT_FREE) in kinds:
                raise InvalidValue(f"{self._where}: its base is free to move; give an arm with a fixed base.")
            if any(kind != int(mujoco.mjtJoint.mjJNT_HINGE) for kind in kinds) or count > 1:
                name = model.body(body).name
                raise InvalidValue(
                    f"{self._where}: {name!r} has another joint than one revolute joint; only such arms are served."
                )
            if count and not model.joint(first).name:
                raise InvalidValue(
                    f"{self._where}: the joint of {model.body(body).name!r} has no name; give it that of the robot's "
                    "messages."
                )
            joints += [int(first)] if count else []
            body = int(model.body_parentid[body])
        if not _FEWEST_JOINTS <= len(joints) <= _MOST_JOINTS:
            name, flag = model.body(self._end).name, "--tip" if is_urdf(Path(self._where)) else "--site"
            raise InvalidValue(
                f"{self._where}: {len(joints)} joints lead to {name.removesuffix(_END)!r}; an arm has 4 to 8. If "
                f"that is not its end, give {flag}."
            )
        return joints[::-1]

    def _range(self, joint: int) -> tuple[float, float]:
        if not self._model.jnt_limited[joint]:
            self._notes.append(f"{self._model.joint(joint).name} turns without end: its limits are +-2 pi")
            return -CONTINUOUS, CONTINUOUS
        low, high = self._model.jnt_range[joint].tolist()
        return low, high

    def _effort(self, joint: int, name: str) -> float | None:
        """The torque of a joint [N m], from the first place that names one; None if none does."""
        model, ranges = self._model, []
        if model.jnt_actfrclimited[joint]:
            ranges.append(model.jnt_actfrcrange[joint])
        for actuator in range(model.nu):
            of_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
            if of_joint and model.actuator_trnid[actuator, 0] == joint:
                if model.actuator_forcelimited[actuator]:
                    ranges.append(model.actuator_forcerange[actuator])
                elif model.actuator_gaintype[actuator] == 0 and model.actuator_biastype[actuator] == 0:
                    ranges.append(model.actuator_ctrlrange[actuator])
        efforts = [self._limits.get(name, (None, None))[1], *(float(np.abs(one).max()) for one in ranges)]
        return _believable(efforts, NewtonMetres)

    def _owners(self, joints: list[int]) -> NDArray[np.int64]:
        """For each body the link it is fixed to: 0 the base, k what joint k turns, k + 1 the gripper, -1 other."""
        model = self._model
        owner = np.zeros(model.nbody, np.int64)
        links = {int(model.jnt_bodyid[joint]): number for number, joint in enumerate(joints, 1)}
        gripper = len(joints) + 1
        for body in range(1, model.nbody):
            parent = int(owner[model.body_parentid[body]])
            if body in links:
                owner[body] = links[body]
            elif body == self._end or parent == gripper:
                owner[body] = gripper
            elif not model.body_jntnum[body]:
                owner[body] = parent
            elif parent == len(joints):
                owner[body] = gripper
            else:
                name = model.body(body).name
                raise InvalidValue(f"{self._where}: {name!r} moves beside the arm; give a file with one arm alone.")
        self._check_free(joints, owner)
        return owner

    def _check_free(self, joints: list[int], owner: NDArray[np.int64]) -> None:
        """Refuse an arm with a joint that follows another, or with links that are tied together."""
        model, kinds = self._model, mujoco.mjtEq
        for row in range(model.neq):
            kind, ends = int(model.eq_type[row]), [int(model.eq_obj1id[row]), int(model.eq_obj2id[row])]
            if kind == int(kinds.mjEQ_JOINT) and ends[0] in joints:
                name = model.joint(ends[0]).name
                raise InvalidValue(f"{self._where}: the joint {name!r} follows another; each joint needs a drive.")
            if kind in (int(kinds.mjEQ_CONNECT), int(kinds.mjEQ_WELD)):
                sites = int(model.eq_objtype[row]) == int(mujoco.mjtObj.mjOBJ_SITE)
                bodies = model.site_bodyid[ends] if sites else ends
                one, other = sorted(int(owner[body]) for body in bodies)
                if one != other <= len(joints):
                    raise InvalidValue(f"{self._where}: its links form a loop; an arm is one chain of joints.")

    def _points(self, bodies: Any, frame: Array) -> Array:
        """Points of the geoms of these bodies in `frame`: vertices of meshes, points on other shapes. Shape: (n, 3)."""
        model, data = self._model, self._data
        parts = [_geom_points(model, data, geom) for geom in _solid(model, bodies)]
        points = np.concatenate([np.zeros((0, 3)), *parts])
        back = np.linalg.inv(frame)
        result: Array = points @ back[:3, :3].T + back[:3, 3]
        return result

    def _grip(self, arm: ReadArm, owner: NDArray[np.int64], last: Array) -> None:
        """Tool, width and points of the gripper."""
        model, data, link = self._model, self._data, len(arm.names) + 1
        bodies = owner == link
        flange = np.eye(4)
        flange[:3, :3], flange[:3, 3] = data.xmat[self._end].reshape(3, 3), data.xpos[self._end]
        flange[:3, :3] = flange[:3, :3] @ self._out
        grip: list[Array]
        if self._parallel is not None:
            length = _length(self._parallel)
            tool = flange.copy()
            tool[:3, 3] += (self._begin + length) * flange[:3, 2]
            palm, pads = (_box(low, high) - [0.0, 0.0, length] for low, high in _pads(self._parallel))
            fixed = self._points(bodies & ~_moved_bodies(model, self._finger_joints(bodies)), tool)
            arm.width, arm.gripper_mass, grip = self._parallel, 0.5, [fixed, palm, pads]
            self._notes.append(f"the gripper is {length:.3f} m long from the end of the arm to the middle of its pads")
        else:
            tool, arm.width = self._fingers(bodies, flange)
            arm.gripper_mass = float(np.clip(model.body_mass[bodies].sum(), 0.05, 2.0))
            moved = _moved_bodies(model, self._finger_joints(bodies)) & bodies
            back = np.linalg.inv(tool)
            fingers = _finger_groups(model, moved, lambda body: _body_points(model, data, body))
            body = self._points(bodies & ~moved, tool)
            grip = [body, *(one @ back[:3, :3].T + back[:3, 3] for one in fingers)]
        arm.tool = np.linalg.inv(last) @ tool
        if self._parallel is None and self._pivot is not None:  # the last link is also the fixed finger of a jaw
            back = np.linalg.inv(arm.tool)
            along = arm.points[-1] @ back[:3, :3].T + back[:3, 3]
            finger = along[:, 2] > (back @ np.linalg.inv(last) @ self._pivot)[2]
            grip, arm.points[-1] = [*grip, along[finger]], arm.points[-1][~finger]
        arm.grip = grip

    def _fingers(self, bodies: Any, flange: Array) -> tuple[Array, float]:
        """Pose of the tool, between the tips of the fingers, and the width of the gripper, left open [m]."""
        model, data = self._model, self._data
        joints = self._finger_joints(bodies)
        if not joints:
            raise InvalidValue(
                f"{self._where}: no joint moves a finger. Give the gripper: --gripper FILE or --gripper parallel:WIDTH."
            )
        moved = _moved_bodies(model, joints) & bodies
        shapes = [self._tips(moved, bodies, flange, state) for state in self._gripper_states(joints)]
        farthest = max(tips.reach for tips in shapes)
        near = [tips for tips in shapes if tips.reach > farthest - _FINGERTIP]  # a jaw that opens wide turns away
        narrow, wide = min(near, key=lambda tips: tips.gap), max(near, key=lambda tips: tips.gap)
        if (opening := wide.gap - max(0.0, narrow.gap)) < 0.003:
            raise InvalidValue(f"{self._where}: its gripper does not open. Give --gripper parallel:WIDTH instead.")
        data.qpos[:] = wide.state
        mujoco.mj_kinematics(model, data)
        pose = np.eye(4)
        pose[:3, :3] = flange[:3, :3] @ wide.axes
        pose[:3, 3] = flange[:3, :3] @ narrow.point + flange[:3, 3]
        return pose, round(min(opening, WIDEST), 4)

    def _finger_joints(self, bodies: Any) -> list[int]:
        return [joint for joint in range(self._model.njnt) if bodies[self._model.jnt_bodyid[joint]]]

    def _gripper_states(self, joints: list[int]) -> Iterator[Array]:
        """Positions of all joints with the fingers at the ends of their travel, in every combination, and between."""
        model, data = self._model, self._data
        actuators = [a for a in range(model.nu) if _drives(model, a, joints)]
        if model.neq and actuators:  # a linkage: where its drives lead it, the arm held, without weight or contact
            still = [v for v in range(model.nv) if model.dof_jntid[v] not in joints]
            held = [model.jnt_qposadr[j] for j in range(model.njnt) if j not in joints]
            model.opt.gravity[:] = 0.0
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
            for ends in _combinations(model.actuator_ctrlrange[actuators]):
                mujoco.mj_resetData(model, data)
                data.ctrl[actuators] = ends
                for _ in range(int(_SETTLING / model.opt.timestep)):
                    data.qpos[held], data.qvel[still] = 0.0, 0.0
                    mujoco.mj_step(model, data)
                if any(data.warning[kind].number for kind in _DIVERGED):
                    raise InvalidValue(
                        f"{self._where}: its gripper, simulated, does not come to rest: give its actuator less gain, "
                        "or --gripper parallel:WIDTH instead."
                    )
                data.qpos[held] = 0.0
                yield data.qpos.copy()
            return
        kind = int(mujoco.mjtEq.mjEQ_JOINT)
        followers = {int(model.eq_obj1id[row]): row for row in range(model.neq) if int(model.eq_type[row]) == kind}
        leaders = [joint for joint in joints if joint not in followers]
        for ends in _combinations(model.jnt_range[leaders]):
            state = np.zeros(model.nq)
            state[model.jnt_qposadr[leaders]] = ends
            for joint, row in followers.items():
                lead = state[model.jnt_qposadr[model.eq_obj2id[row]]]
                state[model.jnt_qposadr[joint]] = np.polyval(model.eq_data[row, 4::-1], lead)
            yield state

    def _tips(self, moved: Any, bodies: Any, flange: Array, state: Array) -> "_Tips":
        """The tips of the two fingers with all joints at `state`, in the frame of the arm's end."""
        model, data = self._model, self._data
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        back = np.linalg.inv(flange)

        def cloud(body: int) -> Array:
            points: Array = _body_points(model, data, body) @ back[:3, :3].T + back[:3, 3]
            return points

        groups = _finger_groups(model, moved, cloud)
        if len(groups) == 1:  # one jaw moves against a fixed one
            fixed = [cloud(int(body)) for body in np.flatnonzero(bodies & ~moved)]
            if not sum(map(len, fixed)):  # the last link, with what is fixed to it
                fixed = [cloud(int(body)) for body in np.flatnonzero(model.body_weldid == model.body_weldid[self._end])]
            groups.append(np.concatenate(fixed))
            jaw = int(np.flatnonzero(moved)[0])
            self._pivot = np.append(data.xanchor[model.body_jntadr[jaw]], 1.0)
        if not all(map(len, groups)):
            raise InvalidValue(f"{self._where}: its fingers have no shapes. Give --gripper parallel:WIDTH instead.")
        wrist = back[:3, :3] @ data.xanchor[self._last] + back[:3, 3]
        way = np.concatenate(groups).mean(axis=0) - wrist
        out = np.zeros(3)
        out[np.abs(way).argmax()] = np.sign(way[np.abs(way).argmax()])
        reach = min(float((group @ out).max()) for group in groups)
        tips = [group[group @ out > reach - _FINGERTIP] for group in groups]
        apart = tips[0].mean(axis=0) - tips[1].mean(axis=0)
        apart -= out * (apart @ out)
        axis = np.zeros(3)
        axis[np.abs(apart).argmax()] = 1.0
        close = apart / np.linalg.norm(apart) if np.linalg.norm(apart) > 1e-3 else axis
        inner = float((tips[0] @ close).min()), float((tips[1] @ close).max())
        across = np.cross(out, close)
        side = np.concatenate(tips) @ across
        point = out * (reach - 0.5 * _FINGERTIP) + close * 0.5 * sum(inner) + across * 0.5 * (side.min() + side.max())
        return _Tips(np.stack([close, across, out], axis=1), point, inner[0] - inner[1], reach, state)


@dataclass
class _Tips:
    """The tips of two fingers."""

    axes: Array
    """Closing axis, the axis across and the axis out of the gripper, as columns. Shape: (3, 3)."""
    point: Array
    """The point between the tips [m]. Shape: (3,)."""
    gap: float
    """Distance between them [m]; below 0 where they overlap."""
    reach: float
    """How far out they reach [m]."""
    state: Array
    """Positions of all joints."""


def _combinations(ranges: Array) -> Iterator[Array]:
    """Both ends of each of some ranges (k, 2), in every combination of up to three of them; one is also divided."""
    if len(ranges) == 1:
        yield from np.linspace(ranges[:, 0], ranges[:, 1], 9)
    elif len(ranges) < 4:
        yield from (np.array(ends) for ends in itertools.product(*ranges.tolist()))
    else:
        yield from (ranges[:, 0], ranges[:, 1])


def _drives(model: Any, actuator: int, joints: list[int]) -> bool:
    """Whether an actuator moves one of `joints`, by itself or by a tendon."""
    target = int(model.actuator_trnid[actuator, 0])
    if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
        return target in joints
    return bool(model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_TENDON)


def _moved_bodies(model: Any, joints: list[int]) -> Any:
    """Whether each body is moved by one of `joints`."""
    moved = np.zeros(model.nbody, bool)
    first = {int(model.jnt_bodyid[joint]) for joint in joints}
    for body in range(1, model.nbody):
        moved[body] = body in first or moved[model.body_parentid[body]]
    return moved


def _finger_groups(model: Any, moved: Any, cloud: Callable[[int], Array]) -> list[Array]:
    """Points of the fingers: of moved bodies that hang together, the two groups that reach farthest."""

    def top(body: int) -> int:
        parent = int(model.body_parentid[body])
        return top(parent) if moved[parent] else body

    groups: dict[int, list[Array]] = {}
    for body in map(int, np.flatnonzero(moved)):
        groups.setdefault(top(body), []).append(cloud(body))
    points = [np.concatenate(group) for group in groups.values()]
    return sorted(filter(len, points), key=lambda group: -float(np.linalg.norm(group, axis=1).max()))[:2]


def _body_points(model: Any, data: Any, body: int) -> Array:
    geoms = range(model.body_geomadr[body], model.body_geomadr[body] + model.body_geomnum[body])
    return np.concatenate([np.zeros((0, 3)), *(_geom_points(model, data, geom) for geom in geoms)])


def _geom_points(model: Any, data: Any, geom: int) -> Array:
    """Points on a geom in the world: vertices of a mesh, else corners of boxes and rings about round shapes."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    kinds = mujoco.mjtGeom
    if kind == int(kinds.mjGEOM_MESH):
        mesh = model.geom_dataid[geom]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = model.mesh_vert[first : first + count].astype(np.float64)
        faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
        points = np.concatenate([points, _between(points[model.mesh_face[faces[0] : sum(faces)]])])
    elif kind == int(kinds.mjGEOM_BOX):
        points = _box(-size, size)
    elif kind in (
        int(kinds.mjGEOM_SPHERE),
        int(kinds.mjGEOM_CAPSULE),
        int(kinds.mjGEOM_CYLINDER),
        int(kinds.mjGEOM_ELLIPSOID),
    ):
        turn = np.linspace(0.0, 2 * np.pi, 16, endpoint=False)
        rise = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 7)
        ball = np.array([[np.cos(r) * np.cos(t), np.cos(r) * np.sin(t), np.sin(r)] for r in rise for t in turn])
        if kind == int(kinds.mjGEOM_ELLIPSOID):
            points = ball * size
        elif kind == int(kinds.mjGEOM_CYLINDER):
            ring = np.stack([np.cos(turn), np.sin(turn), np.zeros(16)], axis=1) * size[0]
            points = np.concatenate([ring + np.array([0.0, 0.0, z]) for z in np.linspace(-size[1], size[1], 8)])
        else:
            half = size[1] if kind == int(kinds.mjGEOM_CAPSULE) else 0.0
            points = np.concatenate([ball * size[0] + [0, 0, z] for z in np.linspace(-half, half, 8 if half else 1)])
    else:
        return np.zeros((0, 3))
    turn_matrix = data.geom_xmat[geom].reshape(3, 3)
    result: Array = points @ turn_matrix.T + data.geom_xpos[geom]
    return result


def _box(low: Array, high: Array) -> Array:
    """Points on a grid in a box."""
    sides = [np.linspace(start, end, 6) for start, end in zip(low, high, strict=True)]
    points: Array = np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)
    return points


def _between(triangles: Array) -> Array:
    """Points inside large triangles (n, 3, 3), about 2 cm apart: the corners alone do not show where a tube is."""
    length = np.linalg.norm(triangles - np.roll(triangles, 1, axis=1), axis=2).max(axis=1)
    points = [np.zeros((0, 3))]
    for corners, longest in zip(triangles[length > 0.03], length[length > 0.03], strict=True):
        parts = min(20, int(longest / 0.02) + 1)
        shares = [(i / parts, j / parts) for i in range(parts + 1) for j in range(parts + 1 - i)]
        points += [
            np.array([corners[0] + i * (corners[1] - corners[0]) + j * (corners[2] - corners[0]) for i, j in shares])
        ]
    return np.concatenate(points)
