"""What everything stands on: robots, tasks, environments, errors, spaces and time."""
