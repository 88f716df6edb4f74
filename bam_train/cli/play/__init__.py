"""`bam-play`: the program, and what keys come from: a terminal, a window, a gamepad."""
