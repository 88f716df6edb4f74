"""The name by which whole-algorithm checkpoints of earlier releases find their filter."""

from bam_train.trainers.rllib.robot_env_runner import MeanStdFilter as MeanStdFilter
