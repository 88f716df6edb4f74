"""`bam-data COMMAND`: collect, check and turn data sets into other formats."""

from functools import partial

from bam_train.cli.program import Command, run_commands

_HERE = "bam_train.cli.data"
_FLAGS = f"{_HERE}.data_flags"
COMMANDS = {
    "collect": Command(
        "run a policy in simulation and record it", f"{_FLAGS}:CollectConfig", f"{_HERE}.recorded:collect"
    ),
    "import": Command(
        "add episodes of recordings or Parquet rows", f"{_FLAGS}:ImportConfig", f"{_HERE}.recorded:import_"
    ),
    "check": Command("say what is whole, and mend the rest", f"{_FLAGS}:CheckConfig", f"{_HERE}.recorded:check"),
    "info": Command("what it is of, and how much is in it", f"{_FLAGS}:InfoConfig", f"{_HERE}.opened:show_info"),
    "stats": Command(
        "success by groups, and the size of every number", f"{_FLAGS}:StatsConfig", f"{_HERE}.opened:show_stats"
    ),
    "export": Command("write it for another library", f"{_FLAGS}:ExportDataConfig", f"{_HERE}.opened:export_data"),
    "merge": Command("add the episodes of several to one", f"{_FLAGS}:MergeConfig", f"{_HERE}.opened:merge_data"),
    "split": Command(
        "split it in two, for training and for testing", f"{_FLAGS}:SplitConfig", f"{_HERE}.opened:split_data"
    ),
    "filter": Command(
        "copy the episodes for which something holds", f"{_FLAGS}:FilterConfig", f"{_HERE}.opened:filter_data"
    ),
    "plot": Command(
        "draw episodes, distributions, success and failures", f"{_FLAGS}:PlotConfig", f"{_HERE}.opened:plot_data"
    ),
    "show": Command("play an episode as a film", f"{_FLAGS}:ShowConfig", f"{_HERE}.opened:show_episode"),
}
WHAT = "Record, check and convert data sets: episodes for learning."
main = partial(run_commands, "bam-data", WHAT, COMMANDS)

if __name__ == "__main__":
    main()
