"""`bam-sign`: keys, signatures of checkpoints, and whom this computer trusts."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from bam_train.cli.console import tell
from bam_train.cli.program import run_program

if TYPE_CHECKING:
    from bam_train.cli.flags import SignConfig

FLAGS = {"keygen": "name", "sign": "key", "verify": "keys", "trust": "keys"}
"""Action to the flag that it takes."""


def sign_checkpoint(config: SignConfig) -> None:
    """Run the program with its parsed flags."""
    from bam_train.checkpoint import Checkpoint
    from bam_train.checkpoint.signature import make_key, public_path, sign, trust, trusted_folder, verify
    from bam_train.errors import SettingsError

    for name in FLAGS.values():
        if getattr(config, name) is not None and name != FLAGS[config.action]:
            raise SettingsError(f"{config.action} has no use for --{name}; leave it out")
    path, folder = config.file.expanduser(), (config.keys or trusted_folder()).expanduser()
    if config.action == "keygen":
        public = make_key(path, config.name or path.stem)
        tell(
            f"{path}: the private key of {public.name}; keep it secret, and away from the robot",
            f"  next      copy {public_path(path)} to the robot's computer and run there",
            f"            bam-sign trust {public_path(path).name}",
        )
    elif config.action == "sign":
        if config.key is None:
            raise SettingsError("--key is missing: the private key that signs. Make one with bam-sign keygen")
        made = sign(path, config.key.expanduser())
        tell(f"{path}: signed by {made.signer}, {made.created}")
    elif config.action == "verify":
        found = verify(Checkpoint.open(path), folder)
        tell(f"{path}: signed by {found.signer}, {found.created}; every member is as signed")
    else:
        tell(f"{trust(path, folder)}: trusted from now on")


main = partial(run_program, "bam-sign", "bam_train.cli.flags:SignConfig", lambda config, _: sign_checkpoint(config))

if __name__ == "__main__":
    main()
