"""The folder of this user's configuration."""

import os
from pathlib import Path


def config_folder() -> Path:
    """This user's configuration folder: ``bam-train`` below ``$XDG_CONFIG_HOME`` or ``~/.config``."""
    return Path(os.environ.get("XDG_CONFIG_HOME") or "~/.config").expanduser() / "bam-train"
