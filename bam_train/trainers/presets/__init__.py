"""Tuned settings as data, laid out like a ``--config`` file.

``<environment>-<algorithm>.toml`` is for sb3, ``<environment>-<trainer>-<algorithm>.toml`` for any other trainer.
"""

from importlib import resources
from typing import Any

from bam_train.settings import file_stem, parse_config


def list_presets() -> list[str]:
    """File names of all presets, sorted."""
    names = (entry.name for entry in resources.files(__name__).iterdir())
    return sorted(name for name in names if name.endswith(".toml"))


def read_preset(env: str, algo: str, trainer: str = "sb3") -> dict[str, Any]:
    """The tuned settings of an environment and an algorithm of a trainer; {} if there are none.

    Raises:
        SettingsError: The file is not as it should be.
    """
    name = f"{file_stem(env, algo, trainer)}.toml"
    if name not in list_presets():
        return {}
    return parse_config(name, resources.files(__name__).joinpath(name).read_text(encoding="utf-8"))
