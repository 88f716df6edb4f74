"""Damage copies of a folder ``pretrained_model`` in several ways; print what `bam-export` says of each, as JSON.

The arguments are the folder of a policy that `lerobot_policy` made, and a folder for the copies.
"""

import contextlib
import io
import json
import shutil
import sys
from pathlib import Path

import lerobot_beside_torch  # noqa: F401
from safetensors.numpy import load_file, save_file

from bam_train.cli.export import main

made, copies = Path(sys.argv[1]), Path(sys.argv[2])
STATE, FLAGS = "observation.state", ("--robot-model", "so101", "--units", "degrees")
BEFORE, NORMALIZER = "policy_preprocessor.json", "policy_preprocessor_step_3_normalizer_processor.safetensors"


def replaced(name, *change):
    """Replace text in a file."""

    def damage(folder):
        (folder / name).write_text((folder / name).read_text().replace(*change))

    return damage


def without_mean(folder):
    arrays = load_file(folder / NORMALIZER)
    save_file({name: one for name, one in arrays.items() if name != f"{STATE}.mean"}, folder / NORMALIZER)


DAMAGES = {
    "no processors": lambda folder: (folder / BEFORE).unlink(),
    "unknown step": replaced(BEFORE, "to_batch_processor", "delta_action_processor"),
    "no file of statistics": lambda folder: (folder / NORMALIZER).unlink(),
    "no statistics": replaced(BEFORE, '"state_file"', '"no_file"'),  # as of a normaliser that was never given any
    "no mean": without_mean,
    "another version": replaced("config.json", "{", '{"attention_of_tomorrow": true, ', 1),
    "another size": replaced("config.json", '"dim_model": 32', '"dim_model": 64'),
    "cut weights": lambda folder: (folder / "model.safetensors").write_bytes(b"\x10\0\0"),
    "no steps": lambda folder: (folder / BEFORE).write_text("{}"),
}
CHUNKS = ("size=5", "steps=9", "ensemble=much", "stpes=4", "overlap=4")


def said(folder, *flags):
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.suppress(SystemExit):
        main([f"lerobot:{folder}", "--data", str(made / "data"), "--out", str(copies / "a.zip"), *FLAGS, *flags])
    return errors.getvalue().replace(str(folder), "FOLDER").splitlines()[-2:]


found = {}
for name, damage in DAMAGES.items():
    copy = copies / name.replace(" ", "-")
    shutil.copytree(made / "pretrained_model", copy)
    damage(copy)
    found[name] = said(copy)
for option in CHUNKS:
    found[option] = said(made / "pretrained_model", "--chunk", option)
print(json.dumps(found))
