"""Running a frozen policy on a robot at its own rate: the loop, its deadlines, its display and its report. No torch."""
