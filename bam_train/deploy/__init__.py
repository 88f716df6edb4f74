"""Running a frozen policy on a robot at its rate: the loop, deadlines and the report; without torch."""
