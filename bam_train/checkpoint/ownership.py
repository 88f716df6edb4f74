"""Whether another user of this computer could change a file that says who or what is trusted."""

import os
import stat
from pathlib import Path


def who_else(path: Path) -> str:
    """Why another user could change or replace what is at `path`, and the remedy; empty if nobody could.

    As sshd does with ``StrictModes``, the owner and the mode of the file are checked, and of every folder above it. A
    folder above may be writable for a group of this user alone, and for all if it is sticky, as ``/tmp`` is.
    """
    if os.name != "posix":
        return ""
    user = os.geteuid()
    for place in dict.fromkeys(map(Path, (os.path.abspath(path), os.path.realpath(path)))):
        for one in (place, *place.parents):
            found = one.lstat()
            if found.st_uid not in (0, user):
                return f"{one} belongs to {_user(found.st_uid)}. Run: chown {_user(user)} {one}"
            if stat.S_ISLNK(found.st_mode) or (one != place and found.st_mode & stat.S_ISVTX):
                continue
            is_shared = one == place or not _is_own(found.st_gid, user)
            if found.st_mode & (stat.S_IWOTH | (stat.S_IWGRP if is_shared else 0)):
                return f"others can write to {one}. Run: chmod go-w {one}"
    return ""


def _user(number: int) -> str:
    import pwd  # only of POSIX

    try:
        return pwd.getpwuid(number).pw_name
    except KeyError:
        return str(number)


def _is_own(group: int, user: int) -> bool:
    """Whether a group is of `user` alone, as its name shows: many systems make one for each user."""
    import grp

    try:
        return grp.getgrgid(group).gr_name == _user(user)
    except KeyError:
        return False
