"""The wheel: what it holds, what it asks for, what it installs."""

import email
import importlib.metadata
import importlib.util
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
NPM = '#!/bin/sh\n[ "$1" = "pack" ] && tar -czf it.tgz -C {0}/$2 package\n'


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation"]
    environment = {**os.environ, "PIP_DISABLE_PIP_VERSION_CHECK": "1"}
    subprocess.run([*command, "--wheel-dir", str(folder), str(ROOT)], check=True, env=environment)
    with zipfile.ZipFile(next(folder.glob("*.whl"))) as archive:
        yield archive


@pytest.fixture(scope="module")
def metadata(wheel):
    name = next(name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    return email.message_from_string(wheel.read(name).decode())


def base_requirements(metadata):
    return [one for one in metadata.get_all("Requires-Dist") if "extra ==" not in one]


def test_the_wheel_holds_two_packages_and_nothing_else(wheel):
    tops = {name.split("/")[0] for name in wheel.namelist()}
    assert {name for name in tops if not name.endswith(".dist-info")} == {"bam_envs", "bam_train"}


@pytest.mark.parametrize(
    "name",
    [
        "bam_envs/py.typed",
        "bam_train/py.typed",
        "bam_train/agent/bam-agent.service",
        "bam_envs/robots/physics/models/ur5e_gripper.xml",
        "bam_envs/robots/physics/models/ur5e_cube.xml",
        "bam_envs/robots/physics/models/floor.xml",
        "bam_train/trainers/presets/pick-ppo.toml",
        "bam_train/trainers/presets/reach-ppo.toml",
        "bam_train/trainers/presets/pick-place-ppo.toml",
        "bam_train/agent/console/index.html",
        "bam_train/agent/console/console.css",
        "bam_train/agent/console/main.js",
        "bam_train/agent/console/keys.json",
        "bam_train/agent/console/uplot/uPlot.iife.min.js",
        "bam_train/agent/console/uplot/uPlot.min.css",
        "bam_train/agent/console/uplot/uplot.LICENSE.txt",
        "bam_train/agent/console/three/three.module.min.js",
        "bam_train/agent/console/three/three.core.min.js",
        "bam_train/agent/console/three/OrbitControls.js",
        "bam_train/agent/console/three/three.LICENSE.txt",
    ],
)
def test_the_wheel_holds_types_models_presets_and_the_service(wheel, name):
    assert name in wheel.namelist()


@pytest.fixture
def build(tmp_path, monkeypatch):
    """Runs the build hook in an empty tree, with an npm that has what is installed, with `change` at its end."""
    spec = importlib.util.spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    tree, programs = tmp_path / "tree", tmp_path / "programs"
    for folder in (tree / module.FOLDER, programs):
        folder.mkdir(parents=True)

    def run(version, change=b"", npm=NPM):
        for release, files in module.LIBRARIES.items():
            for member in files:
                path = tmp_path / release / "package" / member
                path.parent.mkdir(parents=True, exist_ok=True)
                installed = ROOT / module.FOLDER / release.partition("@")[0] / module.placed(release, member)
                path.write_bytes(installed.read_bytes() + change)
        (programs / "npm").write_text(npm.format(tmp_path))
        (programs / "npm").chmod(0o755)
        monkeypatch.setenv("PATH", f"{programs}:{os.environ['PATH']}")
        data = {"artifacts": []}
        module.CustomBuildHook(str(tree), {}, None, None, "", "wheel").initialize(version, data)
        assert data == {"artifacts": [f"/{module.FOLDER}/uplot/", f"/{module.FOLDER}/three/"]}
        return sorted(path.name for path in (tree / module.FOLDER).glob("*/*"))

    return run


def test_the_libraries_that_draw_come_from_npm_once(build):
    names = ["OrbitControls.js", "three.LICENSE.txt", "three.core.min.js", "three.module.min.js"]
    names += ["uPlot.iife.min.js", "uPlot.min.css", "uplot.LICENSE.txt"]
    assert build("standard") == names
    assert build("standard", npm="#!/bin/sh\nexit 1\n") == names


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"change": b" "}, "its dist/uPlot.iife.min.js has another SHA-256 than the release had."),
        ({"npm": "#!/bin/sh\nexit 7\n"}, "returned non-zero exit status 7."),
    ],
)
def test_without_the_libraries_there_is_no_wheel_but_an_editable_install_with_a_warning(build, capsys, options, reason):
    text = "uplot@1.6.32, which draws in the console, could not be fetched with npm: "
    with pytest.raises(RuntimeError) as error:
        build("standard", **options)
    assert str(error.value).startswith(text)
    assert str(error.value).endswith(reason)
    assert build("editable", **options) == []
    said = "".join(capsys.readouterr())
    assert f"{reason} Install again when the npm registry can be reached." in said
    assert "three@0.180.0, which draws in the console, could not be fetched with npm: " in said


def test_every_source_file_is_in_the_wheel(wheel):
    sources = [*(ROOT / "bam_train").rglob("*.py"), *(ROOT / "envs" / "bam_envs").rglob("*.py")]
    names = {str(path.relative_to(ROOT)).removeprefix("envs/") for path in sources}
    assert names <= set(wheel.namelist())


def test_console_scripts(wheel):
    name = next(name for name in wheel.namelist() if name.endswith("entry_points.txt"))
    lines = sorted(line for line in wheel.read(name).decode().splitlines() if " = " in line)
    assert lines == [
        "bam-agent = bam_train.cli.live.live_agent:main",
        "bam-compare = bam_train.cli.experiments.compare:main",
        "bam-data = bam_train.cli.data.bam_data:main",
        "bam-deploy = bam_train.cli.deploy:main",
        "bam-doctor = bam_train.cli.live.doctor:main",
        "bam-envs = bam_train.cli.envs:main",
        "bam-eval = bam_train.cli.eval:main",
        "bam-export = bam_train.cli.export:main",
        "bam-gate = bam_train.cli.data.run_gate:main",
        "bam-play = bam_train.cli.play.run_play:main",
        "bam-push = bam_train.cli.live.push:main",
        "bam-replay = bam_train.cli.live.replay:main",
        "bam-robots = bam_train.cli.arms.bam_robots:main",
        "bam-serve = bam_train.cli.serve:main",
        "bam-sign = bam_train.cli.sign:main",
        "bam-sweep = bam_train.cli.experiments.sweep:main",
        "bam-train = bam_train.cli.train:main",
    ]


def test_the_base_install_is_small(metadata):
    names = sorted(re.split("[<>=; ]", one)[0] for one in base_requirements(metadata))
    assert names == [
        "cbor2",
        "cryptography",
        "gymnasium",
        "mcap",
        "msgspec",
        "numpy",
        "onnxruntime",
        "protobuf",
        "pyyaml",
        "rich",
        "roslibpy",
        "safetensors",
        "tomli",
        "tyro",
        "websockets",
    ]


def test_extras(metadata):
    assert sorted(metadata.get_all("Provides-Extra")) == [
        "all",
        "data",
        "dev",
        "docs",
        "mlflow",
        "notebook",
        "offline",
        "rllib",
        "robots",
        "sim",
        "sweep",
        "trackio",
        "train",
        "video",
        "wandb",
    ]


def of_extra(metadata, extra):
    return sorted(one.partition(";")[0].strip() for one in metadata.get_all("Requires-Dist") if f"'{extra}'" in one)


def test_rllib_brings_ray_and_what_training_needs(metadata):
    train, rllib = of_extra(metadata, "train"), of_extra(metadata, "rllib")
    assert rllib == sorted([*train, "ray[rllib]<3,>=2.55"])
    assert set(rllib) <= set(of_extra(metadata, "all"))
    assert not [one for one in base_requirements(metadata) if one.startswith(("ray", "torch"))]


PINNED = ("ray", "pydantic", "pyarrow", "tensorboardx", "dm-tree", "lz4", "ormsgpack", "scipy", "pandas", "optuna")
"""Ray, what its extra rllib asks for, and Optuna."""
TRACKERS = ("mlflow-skinny", "trackio")


def normal(name):
    return re.split(r"[\[<>=~!(; ]", name)[0].lower().replace("_", "-")


def test_what_the_extras_bring_is_pinned_as_installed():
    """Every package that extras bring, and what those bring, is in constraints.txt."""
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = {normal(one): one.partition("==")[2].partition(";")[0] for one in lines if "==" in one}
    wanted, seen = [*PINNED, *TRACKERS], set()
    while wanted:
        name = wanted.pop()
        if name in seen or name == "setuptools":
            continue
        seen.add(name)
        there = importlib.metadata.distribution(name)
        assert pins.get(name) == there.version.partition("+")[0], f"{name}=={there.version} is installed"
        wanted += [normal(one) for one in there.requires or () if ";" not in one]


def test_licence_and_versions(metadata):
    assert metadata["License-Expression"] == "MIT"
    assert metadata["Requires-Python"] == ">=3.10"
    assert any(one.startswith("gymnasium") and ">=1.1" in one for one in base_requirements(metadata))
