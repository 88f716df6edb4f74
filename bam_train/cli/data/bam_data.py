"""`bam-data COMMAND`: collect, check and turn data sets into other formats."""

from __future__ import annotations

import pkgutil
import sys
from dataclasses import dataclass

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program


@dataclass(frozen=True)
class Command:
    """A command of `bam-data`."""

    help: str
    flags: str
    """Its configuration, ``"module:Class"``."""
    run: str
    """Takes the configuration and returns an exit status, ``"module:function"``; imported once the flags are read."""


_RECORDED, _OPENED = "bam_train.cli.data.recorded", "bam_train.cli.data.opened"
_FLAGS, _VIEW = "bam_train.cli.data.data_flags", "bam_train.cli.data.view_flags"
_SEEN = "bam_train.cli.data.pictures"
COMMANDS = {
    "collect": Command("run a policy in simulation and record it", f"{_FLAGS}:CollectConfig", f"{_RECORDED}:collect"),
    "import": Command("add episodes of recordings or Parquet rows", f"{_FLAGS}:ImportConfig", f"{_RECORDED}:import_"),
    "check": Command("say what is whole, and mend the rest", f"{_FLAGS}:CheckConfig", f"{_RECORDED}:check"),
    "info": Command("what it is of, and how much is in it", f"{_VIEW}:InfoConfig", f"{_OPENED}:show_info"),
    "stats": Command(
        "success by groups, and the size of every number", f"{_VIEW}:StatsConfig", f"{_OPENED}:show_stats"
    ),
    "export": Command("write it for another library", f"{_VIEW}:ExportDataConfig", f"{_OPENED}:export_data"),
    "merge": Command("add the episodes of several to one", f"{_VIEW}:MergeConfig", f"{_OPENED}:merge_data"),
    "split": Command("split it in two, for training and for testing", f"{_VIEW}:SplitConfig", f"{_OPENED}:split_data"),
    "filter": Command("copy the episodes for which something holds", f"{_VIEW}:FilterConfig", f"{_OPENED}:filter_data"),
    "plot": Command("draw episodes, distributions, success and failures", f"{_VIEW}:PlotConfig", f"{_SEEN}:plot_data"),
    "show": Command("play an episode as a film", f"{_VIEW}:ShowConfig", f"{_SEEN}:show_episode"),
}


def main(arguments: list[str] | None = None) -> None:
    """Run the command that the first argument names, with the others as its flags."""
    given = sys.argv[1:] if arguments is None else arguments
    name = given[0] if given else ""
    if name in ("-h", "--help"):
        tell("usage: bam-data COMMAND [OPTIONS]", "", "Record, check and convert data sets: episodes for learning.", "")
        tell(*(f"  {command:<10}{row.help}" for command, row in COMMANDS.items()))
        tell("", "bam-data COMMAND --help shows the options of one.")
        raise SystemExit(0)
    if name not in COMMANDS:
        from bam_envs.core.wording import closest

        close = closest(name, COMMANDS)
        what = "COMMAND is missing" if not name else f"there is no command {name!r}"
        choice = f", did you mean {close!r}?" if close else f"; there are {', '.join(COMMANDS)}."
        say(f"bam-data: {what}{choice} Run bam-data --help")
        raise SystemExit(2)
    command = COMMANDS[name]
    run_program(
        f"bam-data {name}",
        command.flags,
        lambda config, _: pkgutil.resolve_name(command.run)(config),
        given[1:],
    )


if __name__ == "__main__":
    main()
