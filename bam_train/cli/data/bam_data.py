"""`bam-data COMMAND`: collect, check and turn data sets into other formats."""

from __future__ import annotations

import pkgutil
import sys
from typing import NamedTuple

from bam_train.cli.console import say, tell
from bam_train.cli.program import run_program


class Command(NamedTuple):
    """A command of `bam-data`."""

    help: str
    flags: str
    """Its configuration, a class of `bam_train.cli.data.data_flags`."""
    run: str
    """``"module:function"`` in this folder; takes the configuration and returns an exit status."""


COMMANDS = {
    "collect": Command("run a policy in simulation and record it", "CollectConfig", "recorded:collect"),
    "import": Command("add episodes of recordings or Parquet rows", "ImportConfig", "recorded:import_"),
    "check": Command("say what is whole, and mend the rest", "CheckConfig", "recorded:check"),
    "info": Command("what it is of, and how much is in it", "InfoConfig", "opened:show_info"),
    "stats": Command("success by groups, and the size of every number", "StatsConfig", "opened:show_stats"),
    "export": Command("write it for another library", "ExportDataConfig", "opened:export_data"),
    "merge": Command("add the episodes of several to one", "MergeConfig", "opened:merge_data"),
    "split": Command("split it in two, for training and for testing", "SplitConfig", "opened:split_data"),
    "filter": Command("copy the episodes for which something holds", "FilterConfig", "opened:filter_data"),
    "plot": Command("draw episodes, distributions, success and failures", "PlotConfig", "opened:plot_data"),
    "show": Command("play an episode as a film", "ShowConfig", "opened:show_episode"),
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
        f"bam_train.cli.data.data_flags:{command.flags}",
        lambda config, _: pkgutil.resolve_name(f"bam_train.cli.data.{command.run}")(config),
        given[1:],
    )


if __name__ == "__main__":
    main()
